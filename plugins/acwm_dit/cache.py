"""The key-value cache of a causal DiT's temporal attention."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from acwm_core.model.dynamics import Cache
from acwm_dit.attention import attend


class TemporalCache(Cache):
    """Keys and values of the last `context` − 1 latent frames, in every layer.

    Together with its own keys and values, a frame sees `context` frames. Keys are stored after
    rotation by their position. Only relative positions matter to rotary attention, so they never
    have to be rotated again.

    Args:
        layers: number of layers of the model.
        context: number of latent frames that a frame sees, including itself.
    """

    def __init__(self, layers: int, context: int) -> None:
        super().__init__(context)
        self.layers = [LayerCache() for _ in range(layers)]

    def expect(self, frames: int, device: torch.device) -> None:
        """Prepare for the evaluation of this many latent frames."""
        kept = min(self.frames, self.context - 1)
        mask = None if frames == 1 else _mask(kept, frames, self.context, device)
        for layer in self.layers:
            layer.mask = mask

    def keep(self, frames: int) -> None:
        """Add the first `frames` frames of the last evaluation to the cache."""
        self.frames += frames
        kept = min(self.frames, self.context - 1)
        for layer in self.layers:
            layer.keep(frames, kept)

    def tensors(self) -> list[Tensor]:
        """All cached keys and values."""
        return [part for layer in self.layers for part in layer.past]


class LayerCache:
    """Keys and values of one layer, each `[B, N · heads, frames, size]`.

    Attributes:
        past: keys and values of earlier frames; empty at first.
        mask: which keys each evaluated frame sees, `[frames, past + frames]`; None means all.
    """

    def __init__(self) -> None:
        self.past: tuple[Tensor, ...] = ()
        self.mask: Tensor | None = None
        self._joined: tuple[Tensor, ...] = ()

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attention of the evaluated frames to the past and to each other."""
        self._joined = (key, value)
        if self.past:
            self._joined = tuple(map(_join, self.past, self._joined))
        return attend(query, *self._joined, mask=self.mask)

    def keep(self, frames: int, kept: int) -> None:
        """Append the first `frames` of the last evaluation, and keep the last `kept` frames."""
        end = frames + (self.past[0].shape[2] if self.past else 0)
        # Cloned, because a view would keep the dropped part in memory.
        self.past = tuple(part[:, :, end - kept : end].clone() for part in self._joined)
        self._joined = ()


def _join(past: Tensor, new: Tensor) -> Tensor:
    return torch.cat([past, new], 2)


@functools.lru_cache(maxsize=64)
def _mask(past: int, frames: int, context: int, device: torch.device) -> Tensor:
    """The mask `[frames, past + frames]`: a frame sees itself and the `context` − 1 before it."""
    with torch.inference_mode(False):
        query = torch.arange(past, past + frames, device=device)[:, None]
        key = torch.arange(past + frames, device=device)
        return (key <= query) & (key > query - context)
