"""What models share that carry the scene as few numbers, and draw each picture from them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.model.objectives.objective import drawn_noise, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.layers import MatrixConv

Scene = TypeVar("Scene")
Course = TypeVar("Course")


class SceneModel(Predictor, Generic[Scene, Course]):
    """Reads the scene from the given frame, moves it, and draws every frame from it.

    The picture is no part of what is carried from frame to frame, so that nothing fades. While it
    learns to draw, it draws what is truly there (teacher forcing).

    A scene is what is known after a latent frame, a course what is drawn: how things are in each
    video frame, from the last given one on.

    Args:
        latent_channels: channels C of the codec.
        temporal_stride: video frames per latent frame of the codec.
        width: size of the conditioner's modulation.

    Attributes:
        name: by which a recipe knows it.
        noise: numbers that a draw depends on, of one that draws futures (`samples`).
    """

    name: str
    noise = 0
    layers, heads = 0, 1
    causal = streams = skips = follows_states = True

    def __init__(self, latent_channels: int, temporal_stride: int, width: int) -> None:
        super().__init__()
        self.latent_channels, self.stride, self.width = latent_channels, temporal_stride, width

    @abstractmethod
    def start(self, given: Latent) -> Scene:
        """What is known after the last of the given frames `[B, K, C, h, w]`."""

    def with_draw(self, scene: Scene, draw: Tensor) -> Scene:
        """The scene with the numbers `[B, noise]` of a draw, on which its future depends."""
        raise NotImplementedError

    @abstractmethod
    def step(self, scene: Scene, told: Tensor) -> tuple[Scene, Any]:
        """The scene one latent frame later, and how things were in its video frames, last first.

        Args:
            scene: after the previous latent frame.
            told: of the actions of its video frames, `[B, stride, …]`, see `told`.
        """

    @abstractmethod
    def drawn(self, scene: Scene, shown: Any) -> Tensor:
        """The latent frame `[B, C, h, w]` that shows what `step` returned."""

    @abstractmethod
    def told(self, embedded: Tensor) -> Tensor:
        """Embedded actions `[B, L, width]` by video frames, `[B, L stride, …]`."""

    @abstractmethod
    def true_course(self, given: Latent, states: Tensor) -> tuple[Scene, Course]:
        """The scene after the given frames, and its course, by the true states `[B, T, S]`."""

    @abstractmethod
    def joined(self, scene: Scene, passed: list[Any]) -> Course:
        """The course of what `step` returned for each latent frame after `scene`."""

    @abstractmethod
    def drawn_course(self, scene: Scene, course: Course, numbers: Tensor) -> Latent:
        """Latent frames `[B, N, C, h, w]` with the numbers `[B, N]`, 1 for the first new one."""

    def states_of(self, course: Course) -> Tensor:
        """The states of a course as they were recorded, `[B, 1 + T, S]`; see `predict_states`."""
        raise NotImplementedError

    @abstractmethod
    def tensors(self, scene: Scene) -> tuple[Tensor, ...]:
        """The scene as tensors."""

    @abstractmethod
    def scene(self, state: tuple[Tensor, ...]) -> Scene:
        """The inverse of `tensors`."""

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        *,
        only: Tensor | None = None,
        states: Tensor | None = None,
        generators: Sequence[torch.Generator] = (),
    ) -> Latent:
        """Predict the latent frames after the given ones, `[B, L − K, C, h, w]`.

        With `only`, those of them; with `states`, it draws true ones instead of its own.
        """
        known = given.shape[1]
        if states is None:
            scene = self._started(given, self._draw(given, generators))
            course = self._followed(scene, conditioning, known, frames)
        else:
            scene, course = self.true_course(given, states)
        numbers = torch.arange(1, frames - known + 1, device=given.device).expand(len(given), -1)
        if only is not None:
            numbers = numbers.gather(1, only)
        return self.drawn_course(scene, course, numbers)

    def predict_states(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        *,
        generators: Sequence[torch.Generator] = (),
    ) -> Tensor:
        """The states that it would draw; see `Predictor.predict_states`."""
        number, scene = len(self.told_of(conditioning)), self.start(given)
        if len(given) < number:
            alike = [each.expand(number, *each.shape[1:]) for each in self.tensors(scene)]
            scene = self.scene(tuple(alike))
        if self.samples:
            scene = self.with_draw(scene, *self._draw(given, generators))
        return self.states_of(self._followed(scene, conditioning, given.shape[1], frames))[:, 1:]

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[torch.Generator] = ()
    ) -> LatentStream:
        """Stream from the scene. `context` is ignored, as the scene holds all that is known."""
        return _SceneStream(self, self._started(given, self._draw(given, generators)))

    def matrices(self) -> list[nn.Parameter]:
        """The weights of the convolutions in the blocks and in the head that draw."""
        return [each.weight for each in self.modules() if isinstance(each, MatrixConv)]

    def initial_state(
        self, given: Latent, conditioning: Conditioning, *draw: Tensor
    ) -> tuple[Tensor, ...]:
        """The first state of a stream that begins with latents `[B, K, C, h, w]`, as tensors.

        `draw` is the noise of a model that draws, `[B, noise]`.
        """
        return self.tensors(self._started(given, draw))

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent frame `[B, 1, C, h, w]` and its state, given the last conditioning."""
        told = self.told_of(conditioning)[:, -self.stride :]
        scene, shown = self.step(self.scene(state), told)
        return self.drawn(scene, shown)[:, None], self.tensors(scene)

    def told_of(self, conditioning: Conditioning) -> Tensor:
        """What `told` makes of a clip's actions.

        Raises:
            RecipeError: the conditioner gives no modulation.
        """
        if conditioning.modulation is None:
            raise RecipeError(
                f"{self.name} takes actions as a modulation, which this conditioner does not give: "
                "set conditioner=adaln"
            )
        return self.told(conditioning.modulation)

    def checked(self, given: Latent) -> Latent:
        """The latents, if they have the right number of channels; raises ShapeError if not."""
        if given.ndim != 5 or given.shape[2] != self.latent_channels:
            raise ShapeError(
                f"{type(self).__name__} takes latents [B, L, {self.latent_channels}, h, w], "
                f"not {list(given.shape)}"
            )
        return given

    def _draw(self, given: Latent, generators: Sequence[torch.Generator]) -> tuple[Tensor, ...]:
        """A draw of one of the futures, `[B, noise]`."""
        return (sent(drawn_noise((self.noise,), generators), given),) if self.samples else ()

    def _started(self, given: Latent, draw: tuple[Tensor, ...]) -> Scene:
        scene = self.start(given)
        return self.with_draw(scene, *draw) if self.samples else scene

    def _followed(
        self, scene: Scene, conditioning: Conditioning, known: int, frames: int
    ) -> Course:
        told, passed, now = self.told_of(conditioning), list[Any](), scene
        for frame in range(known, frames):
            now, shown = self.step(now, told[:, frame * self.stride : (frame + 1) * self.stride])
            passed.append(shown)
        return self.joined(scene, passed)


class _SceneStream(LatentStream):
    """A stream that carries the scene."""

    def __init__(self, model: SceneModel[Any, Any], scene: Any) -> None:
        self._model, self._state = model, model.tensors(scene)

    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame; see `LatentStream.advance`."""
        latent, self._state = self._model.next_state(self._state, conditioning)
        return latent
