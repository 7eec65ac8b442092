"""`CompactReference`: the compact codec, whose decoder sees the frame that a video starts with."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from acwm_codecs.compact import STRIDE, Compact
from acwm_core.errors import DataError
from acwm_core.model.shapes import Frame, Latent

WIDTHS = (32, 64, 96)
"""Channels of the reference's features, at 1/2, 1/4 and 1/8 of its resolution."""

RARELY = -3.0
"""Initial bias of the mask: at first little is taken from the reference as it is."""

COARSE = 5
"""First layers of the decoder: those at 1/8 of the resolution, which have 60 % of its weights."""

COMPLETED_BY = "completed_by"
"""In a file without coarse layers: what identifies those that ship, which complete it."""


class ReferencePath(nn.Module):
    """What a decoder takes from a frame: features of each scale, and pixels as they are.

    Args:
        widths: channels of the decoder's features at 1/2, 1/4 and 1/8 of the frame's resolution.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        before = (3, *WIDTHS)
        self.look = nn.ModuleList(
            nn.Conv2d(old, new, 4, stride=2, padding=1)
            for old, new in zip(before, WIDTHS, strict=False)
        )
        self.tell = nn.ModuleList(
            nn.Conv2d(own, width, 1) for own, width in zip(WIDTHS, widths, strict=True)
        )
        self.mask = nn.Conv2d(widths[0], 4 * STRIDE, 3, padding=1)
        for layer in (*self.tell, self.mask):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)
        nn.init.constant_(self.mask.bias, RARELY)  # pyright: ignore[reportArgumentType]

    def features(self, frame: Frame) -> list[Tensor]:
        """What is added to the decoder's features at 1/8, 1/4 and 1/2 of the resolution."""
        seen, told = frame * 2 - 1, list[Tensor]()
        for look, tell in zip(self.look, self.tell, strict=True):
            seen = functional.silu(look(seen))
            told.append(tell(seen))
        return told[::-1]

    def kept(self, features: Tensor) -> Tensor:
        """The share of each pixel that is taken from the reference, `[N, 4, 1, H, W]`."""
        return torch.sigmoid(functional.pixel_shuffle(self.mask(features), 2).float())[:, :, None]


class CompactReference(Compact):
    """``compact_reference``: the latents of `Compact`, decoded with the given frame at hand.

    What does not move keeps its detail, so only what moves must fit into the latents. The decoder
    that ships has learned from latents as models predict them. Without a reference it decodes as
    `Compact` does.

    Args:
        weights: see `Compact`.
    """

    name = "compact_reference"
    _frozen = False
    _reference: Frame | None = None
    _told: Sequence[Tensor] = ()

    def _make_layers(self) -> None:
        super()._make_layers()
        self.reference = ReferencePath(self.widths)

    def latents_fingerprint(self) -> str:
        """That of `Compact` with the weights that ship, if the encoder is the same."""
        same = self._encodes_as_shipped(super().stored())
        return Compact().fingerprint() if same else super().latents_fingerprint()

    def freeze_coarse(self) -> None:
        """Train only the finer layers from now on; a file then has only these, 3 MB of 7.

        Raises:
            DataError: the coarse layers are not those that ship, which complete such a file.
        """
        shipped = CompactReference().decoder[:COARSE].state_dict()
        coarse = self.decoder[:COARSE]
        if not all(torch.equal(coarse.state_dict()[name], shipped[name]) for name in shipped):
            raise DataError(f"only the coarse layers that ship with {self.name} can be frozen")
        coarse.requires_grad_(False)
        self._frozen = True

    def stored(self) -> dict[str, Tensor]:
        """Without what is frozen, and without the encoder, if it is that which ships."""
        state = super().stored()
        if self._encodes_as_shipped(state):
            shipped = _encoder()
            state = {name: value for name, value in state.items() if name not in shipped}
        if self._frozen:
            coarse = {name: state.pop(name) for name in [*state] if _is_coarse(name)}
            state[COMPLETED_BY] = _identity(coarse)
        return state

    @staticmethod
    def _encodes_as_shipped(state: Mapping[str, Tensor]) -> bool:
        return all(torch.equal(state[name].cpu(), value) for name, value in _encoder().items())

    def _read(self, path: Path) -> dict[str, Tensor]:
        state = load_file(path)
        if (identity := state.pop(COMPLETED_BY, None)) is not None:
            shipped = load_file(self.shipped_weights())
            coarse = {name: value for name, value in shipped.items() if _is_coarse(name)}
            if not torch.equal(_identity(coarse), identity):
                raise DataError(
                    f"codec '{self.name}': {path} completes the weights of another version of "
                    "acwm: train it again, or install that version"
                )
            state |= coarse
        return {**_encoder(), **state}

    def with_reference(self, frame: Frame) -> CompactReference:
        """This codec, as it decodes what follows `frame`, `[B, 3, H, W]` or one for all."""
        seeing = copy.copy(self)  # shares the weights
        seeing._reference, seeing._told = frame, self.reference.features(frame)
        return seeing

    def _groups(self, latents: Latent) -> Tensor:
        if self._reference is None:
            return super()._groups(latents)
        size = latents.shape[:2]
        known = [
            each[:, None].expand(*size, *each.shape[1:]).flatten(0, 1)
            for each in (self._reference, *self._told)
        ]
        return self._decode_from(latents.flatten(0, 1), *known).unflatten(0, size)

    def decode_groups(self, latents: Tensor, reference: Frame | None = None) -> Tensor:
        """Decode latent frames with a reference each; see `Compact.decode_groups`."""
        if reference is None:
            return super().decode_groups(latents)
        return self._decode_from(latents, reference, *self.reference.features(reference))

    def _decode_from(self, latents: Tensor, reference: Frame, *told: Tensor) -> Tensor:
        """Decode with what the reference tells at 1/8, 1/4 and 1/2 of the resolution."""
        first, *layers, draw, shuffle = self.decoder
        finer = iter(told)
        features = first(latents) + next(finer)
        for layer in layers:
            features = layer(features)
            if isinstance(layer, nn.PixelShuffle):
                features = features + next(finer)
        drawn = shuffle(draw(features)).float() / 2 + 0.5
        kept = self.reference.kept(features)
        mixed = kept * reference[:, None] + (1 - kept) * drawn.unflatten(1, (STRIDE, 3))
        return mixed.flatten(1, 2)


def _is_coarse(name: str) -> bool:
    part, layer, *_ = name.split(".")
    return part == "decoder" and int(layer) < COARSE


def _identity(weights: Mapping[str, Tensor]) -> Tensor:
    """The SHA-256 of weights, as 32 bytes."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(weights[name].cpu().numpy().tobytes())
    return torch.frombuffer(bytearray(digest.digest()), dtype=torch.uint8)


def _encoder() -> dict[str, Tensor]:
    """The weights of the encoder and its statistics that ship with `Compact`."""
    shipped = load_file(Compact.shipped_weights())
    return {name: value for name, value in shipped.items() if not name.startswith("decoder.")}
