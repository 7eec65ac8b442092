"""Training checkpoints of the published ACWM-DiT (arXiv 2605.08567)."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from acwm_core.errors import DataError
from acwm_core.model.conditioner import Conditioner
from acwm_core.model.dynamics import DynamicsModel
from acwm_dit.adaln import AdaLN
from acwm_dit.cross_attention import CrossAttention
from acwm_dit.dit import DiT
from acwm_dit.plugin import SIZES
from acwm_dit.published import convert, published_shapes
from acwm_zoo.importer import CheckpointImporter, ForeignModel, State

STATE = "model_state_dict"
WRAPPER, NETWORK = "module.", "model."
"""Prefixes of names: the first is optional (distributed training), the second always there."""

CODEC, SCHEDULER = ASIDE = ("vae.", "scheduler.")
"""Prefixes of other entries: the frozen codec and the noise schedule."""

WAN = ("encoder.", "decoder.", "conv1.", "conv2.")
"""Prefixes of the names in Wan's original release."""

TRAINED_WITH: Mapping[str, Any] = {
    "codec": {"name": "wan"},
    "objective": {
        "name": "diffusion_forcing",
        "shift": 5.0,
        "prediction": "velocity",
        "loss_on": "velocity",
        "weighting": "gaussian",
        "steps": 49,  # evaluations on the published schedule of 50 points
    },
    "training": {"learning_rate": 1e-4, "ema_decay": 0.0},
    "data": {"batch_size": 4},
    "trainer": {"max_steps": 100_000, "gradient_clip_val": 1.0},
}
"""Recipe sections with which the published checkpoints were trained."""


class PublishedCheckpoint(CheckpointImporter):
    """``latest.pt`` of the published training code.

    Width, layers, action size and conditioner follow from the shapes. The number of heads follows
    from them for the known sizes only. Whether attention is causal in time cannot be seen: it
    follows from the objective, which is diffusion forcing unless an override says otherwise.
    """

    def read(self, content: Mapping[str, Any]) -> ForeignModel | None:
        """See `CheckpointImporter.read`. Recognised by the names of the first block."""
        entries = content.get(STATE)
        if not isinstance(entries, Mapping):
            return None
        state = {_unwrapped(str(k)): v for k, v in cast(Mapping[Any, Any], entries).items()}
        if not any(name.startswith(f"{NETWORK}blocks.0.s_block.") for name in state):
            return None
        weights = _network(state)
        width, channels, patch, _ = _shape(weights, "x_proj.weight", 4)
        layers = len({name.split(".")[1] for name in weights if name.startswith("blocks.")})
        size = {(d, n): name for name, (d, n, *_) in SIZES.items()}.get((width, layers))
        model = {"name": size} if size else {"name": "dit_xs", "width": width, "layers": layers}
        codec = _codec(state)
        crossing = any(".action_cross_attn." in name for name in weights)
        conditioner = "cross_attention" if crossing else "adaln"
        return ForeignModel(
            sections={
                **TRAINED_WITH,
                "model": {**model, "patch_size": patch},
                "conditioner": {"name": conditioner, "embedding": "convolutional"},
            },
            latent_channels=channels,
            temporal_stride=4,
            action_size=_shape(weights, "action_embedder.mlp_in.0.weight", 2)[1],
            step=_step(content.get("step")),
            convert=functools.partial(_convert, weights),
            untold={} if size else {"model.heads": _untold_heads(width, layers)},
            codec_weights=codec,
            notes=_notes(content, state, [SCHEDULER] if codec else ASIDE),
        )

    def example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """One narrow layer with cross-attention, and some entries that are ignored."""
        fit: dict[str, Any] = {"width": 16, "layers": 1, "heads": 2}
        with torch.device("meta"):
            model = DiT(latent_channels=4, **fit)
            conditioner = CrossAttention(
                action_size=2, temporal_stride=4, embedding="convolutional", **fit
            )
        generator = torch.Generator().manual_seed(0)
        state = {
            f"{NETWORK}{name}": torch.randn(shape, generator=generator)
            for name, shape in published_shapes(model, conditioner).items()
        }
        aside = {"vae.encoder.weight": torch.zeros(1), "scheduler.sigmas": torch.zeros(1)}
        return {STATE: {**state, **aside}, "step": 3, "epoch": 1}, ("model.heads=2",)


def _unwrapped(name: str) -> str:
    return name.removeprefix(WRAPPER)


def _network(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The network's tensors under their published names."""
    weights: dict[str, Tensor] = {}
    for name, value in state.items():
        if name.startswith(ASIDE):
            continue
        if not name.startswith(NETWORK) or not isinstance(value, Tensor):
            raise DataError(
                f"the checkpoint holds {name!r}, not a tensor of {NETWORK}* or of "
                f"{', '.join(f'{prefix}*' for prefix in ASIDE)}"
            )
        weights[name.removeprefix(NETWORK)] = value
    return weights


def _shape(weights: Mapping[str, Tensor], name: str, axes: int) -> tuple[int, ...]:
    if name not in weights:
        raise DataError(f"the checkpoint lacks {name}")
    shape = tuple(weights[name].shape)
    if len(shape) != axes:
        raise DataError(f"{name} has shape {shape} in the checkpoint, not {axes} axes")
    return shape


def _convert(
    weights: Mapping[str, Tensor], model: DynamicsModel, conditioner: Conditioner
) -> tuple[State, State]:
    if not isinstance(model, DiT) or not isinstance(conditioner, (AdaLN, CrossAttention)):
        raise DataError(
            "published ACWM-DiT weights are for a DiT with the conditioner adaln or "
            "cross_attention: leave out the words model=… and conditioner=…"
        )
    return convert(weights, model, conditioner)


def _step(value: object) -> int:
    return value if isinstance(value, int) and value >= 0 else 0


def _untold_heads(width: int, layers: int) -> str:
    known = ", ".join(f"{name} {d}×{n}" for name, (d, n, *_) in SIZES.items())
    return (
        f"{layers} layers of width {width} are none of the known sizes ({known}), and the weights "
        "don't tell the number of heads"
    )


def _codec(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The codec's weights, if present under the names of Wan's original release, else empty."""
    entries = [name for name in state if name.startswith(CODEC)]
    mark = f"{WAN[0]}conv1.weight"
    wrapper = next((name.removesuffix(mark) for name in entries if name.endswith(mark)), None)
    if wrapper is None:
        return {}
    inside = {name.removeprefix(wrapper): state[name] for name in entries}
    return {
        name: value.float()
        for name, value in inside.items()
        if name.startswith(WAN) and isinstance(value, Tensor)
    }


def _notes(
    content: Mapping[str, Any], state: Mapping[str, Any], prefixes: Sequence[str]
) -> tuple[str, ...]:
    counts = {p: sum(name.startswith(p) for name in state) for p in prefixes}
    left = [f"{prefix}* ({count})" for prefix, count in counts.items() if count]
    left += [str(name) for name in content if name not in (STATE, "step", "epoch")]
    return (f"Left aside: {', '.join(left)}.",) if left else ()
