"""Exports the stream of a world model as three ONNX graphs, which a browser can run.

`start` maps the given frames to the last latent and a state, `step` maps the actions of a latent
frame and the state to the next latent and state, and `decode` maps a latent, and the last given
frame if the codec looks at it, to video frames.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from acwm_core.errors import MissingExtraError, RecipeError
from acwm_core.model.batch import noise_of_clips
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Actions, Frame, Latent, Video
from acwm_core.model.world_model import WorldModel

NEEDS_TORCH = "2.13"
"""With 2.9 the exporter fails on recurrent models; the versions in between are untested."""

MAX_PARAMETERS = 50_000_000
"""The most that a page can load: 200 MB."""

TOLERANCE = 1e-3
"""Share of full scale: a quarter of the step between two values of a pixel."""


@runtime_checkable
class CarriesState(Protocol):
    """What a dynamics model must implement to be exported: its stream as functions of tensors.

    One that draws a future has an attribute ``noise``, how many standard normal numbers it draws at
    the start, and `initial_state` takes them as a further argument `[B, noise]`.
    """

    def initial_state(
        self, given: Latent, conditioning: Conditioning, *draw: Tensor
    ) -> tuple[Tensor, ...]:
        """The state after the given latents `[B, K, C, h, w]`.

        `conditioning` begins with the entry for the first latent frame, which no action leads to.
        """
        ...

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent `[B, 1, C, h, w]` and its state, given the last conditioning entry."""
        ...


class _Part(nn.Module):
    def __init__(self, world: WorldModel) -> None:
        super().__init__()
        self.world = world

    @property
    def model(self) -> CarriesState:
        return cast(CarriesState, self.world.model)

    def embed(self, actions: Actions) -> Conditioning:
        """Conditioning of a first latent frame and of the one that raw actions lead to."""
        rows = self.world.normalise(torch.cat([actions, torch.zeros_like(actions[:, :1])], 1))
        return self.world.conditioner.condition(rows, 2, self.world.model.width)


class StartGraph(_Part):
    """Maps the given frames `[1, K, 3, H, W]` to the latent of the last one and the state.

    For a model that draws, its noise `[1, N]` is a second input.
    """

    def forward(self, given: Video, *draw: Tensor) -> tuple[Tensor, ...]:
        """Encode the frames and start the stream."""
        latents = self.world.codec.encode(given)
        stride, size = self.world.codec.temporal_stride, len(self.world.action_low)
        nothing = self.embed(given.new_zeros(1, stride, size))
        return latents[:, -1:], *self.model.initial_state(latents, nothing, *draw)


class StepGraph(_Part):
    """Maps raw actions `[1, stride, A]` and a state to the next latent and state."""

    def forward(self, actions: Actions, *state: Tensor) -> tuple[Tensor, ...]:
        """Predict one latent frame."""
        latent, moved = self.model.next_state(state, self.embed(actions))
        return latent, *moved


class Decode(_Part):
    """Decodes a latent `[1, 1, C, h, w]` as the first latent frame of a video, and as a later one.

    The two results are the video frames of each case. For a codec that decodes with a reference,
    that frame `[1, 3, H, W]` is a second input.
    """

    def forward(self, latent: Latent, *reference: Frame) -> tuple[Video, Video]:
        """Decode both ways; the common part is computed once."""
        codec = self.world.codec
        decoder = (codec.with_reference(*reference) if reference else codec).frame_decoder()
        return decoder(latent), decoder(latent)


def export_graphs(world: WorldModel, size: tuple[int, int]) -> dict[str, bytes]:
    """Export the graphs, by name.

    Args:
        world: the model, on the CPU.
        size: height and width of frames.

    Raises:
        MissingExtraError: the packages for the export are not installed.
        RecipeError: this model cannot be exported, or PyTorch is too old.
    """
    _check_exportable(world)
    world.eval()
    given = torch.rand(1, world.context_frames, 3, *size)
    actions = world.action_low.expand(1, world.codec.temporal_stride, -1)
    begin = given, *_draw(world, seed=0)
    with torch.no_grad():
        latent, *state = StartGraph(world)(*begin)
        state = [tensor.clone() for tensor in state]  # one given twice would be one input
        states = [f"state_{k}" for k in range(len(state))]
        outputs = ["latent", *(f"next_{name}" for name in states)]
        graph, decoded = _graph, (latent, *_reference(world, given))
        return {
            "start": graph(StartGraph(world), begin, ["given", "noise"], ["latent", *states]),
            "step": graph(StepGraph(world), (actions, *state), ["actions", *states], outputs),
            "decode": graph(Decode(world), decoded, ["latent", "reference"], ["first", "frames"]),
        }


def noise_size(world: WorldModel) -> int:
    """How many numbers a draw of the model takes; 0 for a model that draws none."""
    return getattr(world.model, "noise", 0)


def _draw(world: WorldModel, seed: int) -> tuple[Tensor, ...]:
    """The noise `[1, N]` of a stream with this seed; empty for a model that draws none."""
    noise = noise_size(world)
    return (noise_of_clips((noise,), [torch.Generator().manual_seed(seed)]),) if noise else ()


def _reference(world: WorldModel, given: Video) -> tuple[Frame, ...]:
    """The last given frame `[1, 3, H, W]`; empty if the codec does not look at it."""
    frame = given[:, -1]
    return () if world.codec.with_reference(frame) is world.codec else (frame,)


def _check_exportable(world: WorldModel) -> None:
    name = type(world.model).__name__
    why = None
    if not isinstance(world.model, CarriesState):
        why = f"a {name} cannot be exported: choose a model without sampling, such as recurrent"
    elif not world.codec.memoryless:
        why = f"a {type(world.codec).__name__} has a stateful decoder, which cannot be exported"
    elif sum(weight.numel() for weight in world.parameters()) > MAX_PARAMETERS:
        why = f"this model has more than {MAX_PARAMETERS:,} parameters, too many for a page"
    elif torch.__version__ < NEEDS_TORCH:
        why = (
            f"--export needs PyTorch {NEEDS_TORCH} or later, not {torch.__version__}: upgrade torch"
        )
    if why:
        raise RecipeError(why)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "exporting a model needs onnx: install it with pip install 'acwm[export]'"
        ) from error


def _graph(part: nn.Module, args: tuple[Any, ...], inputs: list[str], outputs: list[str]) -> bytes:
    """Export one graph, serialised with its weights."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # otherwise it lists packages that are not needed
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                part,
                args,
                input_names=inputs[: len(args)],
                output_names=outputs,
                dynamo=True,
                external_data=False,
                verbose=False,
            )
    finally:
        log.setLevel(level)
    assert program is not None
    return program.model_proto.SerializeToString()


class OnnxStream:
    """Streams with the graphs, as the page does, but in Python.

    Args:
        graphs: see `export_graphs`.
        given: frames `[K, 3, H, W]` in [0, 1].
        draw: noise `[1, N]` of a model that draws, otherwise empty.

    Attributes:
        given: the last given frame as the model sees it, `[3, H, W]`.
    """

    def __init__(
        self,
        graphs: Mapping[str, bytes],
        given: NDArray[np.float32],
        draw: Sequence[NDArray[np.float32]] = (),
    ) -> None:
        import onnxruntime

        self._sessions = {
            name: onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
            for name, graph in graphs.items()
        }
        self._reference = given[None, -1]
        latent, *self._state = self._run("start", given[None], *draw)
        first, later = self._run("decode", latent, self._reference)
        self.given: NDArray[np.float32] = (first if len(given) == 1 else later)[0, -1]

    def step(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predict the frames `[stride, 3, H, W]` for `stride` raw actions."""
        latent, *self._state = self._run("step", actions[None], *self._state)
        return self._run("decode", latent, self._reference)[1][0]

    def _run(self, name: str, *values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        session = self._sessions[name]
        names = [argument.name for argument in session.get_inputs()]
        return cast(Any, session.run(None, dict(zip(names, values, strict=False))))


def check(
    graphs: Mapping[str, bytes],
    world: WorldModel,
    given: NDArray[np.float32],
    actions: NDArray[np.float32],
) -> float:
    """Compare the graphs with the PyTorch stream; returns the largest difference of a pixel.

    Args:
        graphs: see `export_graphs`.
        world: the model that they were made from.
        given: frames `[K, 3, H, W]` in [0, 1], as many as the model is given.
        actions: raw actions, `[n · stride, A]`.

    Raises:
        RecipeError: the two differ by more than `TOLERANCE`.
    """
    still = world.action_low.expand(1, len(given) - 1, -1)
    truth = world.stream(torch.from_numpy(given)[None], still, seeds=[0])
    draw = [noise.numpy() for noise in _draw(world, seed=0)]
    stream, stride = OnnxStream(graphs, given, draw), world.codec.temporal_stride
    worst = float(np.abs(stream.given - truth.given[0, -1].numpy()).max())
    for start in range(0, len(actions), stride):
        rows = actions[start : start + stride]
        expected = truth.step(torch.from_numpy(rows)[None])[0].numpy()
        worst = max(worst, float(np.abs(stream.step(rows) - expected).max()))
    if not worst <= TOLERANCE:
        raise RecipeError(
            f"the exported model differs from the original by {worst:.2g} of full scale: if its "
            "conditioner uses the actions of other latent frames, use another, such as adaln"
        )
    return worst
