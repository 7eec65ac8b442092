"""What the temporal attention of a causal DiT keeps of the latent frames that went before."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from acwm_core.dynamics import Cache
from acwm_dit.attention import attend


class TemporalCache(Cache):
    """Keys and values of the last `context` − 1 latent frames, in every layer.

    A frame's own keys and values make it `context` frames that it sees. Keys are kept rotated by
    their position; as only distances matter to attention, they need no turning later.

    Args:
        layers: layers of the model.
        context: latent frames that a frame sees, its own included.
    """

    def __init__(self, layers: int, context: int) -> None:
        super().__init__(context)
        self.layers = [LayerCache() for _ in range(layers)]

    def expect(self, frames: int, device: torch.device) -> None:
        """Prepare for an evaluation of so many latent frames."""
        kept = min(self.frames, self.context - 1)
        mask = None if frames == 1 else _mask(kept, frames, self.context, device)
        for layer in self.layers:
            layer.mask = mask

    def keep(self, frames: int) -> None:
        """Make the first `frames` of those evaluated last the past of those to come."""
        self.frames += frames
        kept = min(self.frames, self.context - 1)
        for layer in self.layers:
            layer.keep(frames, kept)

    def tensors(self) -> list[Tensor]:
        """All that is kept."""
        return [part for layer in self.layers for part in layer.past]


class LayerCache:
    """Keys and values of one layer, each `[B, N · heads, frames, size]`.

    Attributes:
        past: keys and values of earlier frames; empty at first.
        mask: which keys each frame in evaluation sees, `[frames, past + frames]`; None is all.
    """

    def __init__(self) -> None:
        self.past: tuple[Tensor, ...] = ()
        self.mask: Tensor | None = None
        self._joined: tuple[Tensor, ...] = ()

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attention of the frames in evaluation to the past and to each other."""
        self._joined = (key, value)
        if self.past:
            self._joined = tuple(map(_join, self.past, self._joined))
        return attend(query, *self._joined, mask=self.mask)

    def keep(self, frames: int, kept: int) -> None:
        """Let the past end with the first `frames` evaluated last, and be `kept` frames long."""
        end = frames + (self.past[0].shape[2] if self.past else 0)
        # Cloned, as a view would keep what is cut off in memory.
        self.past = tuple(part[:, :, end - kept : end].clone() for part in self._joined)
        self._joined = ()


def _join(past: Tensor, new: Tensor) -> Tensor:
    return torch.cat([past, new], 2)


@functools.lru_cache(maxsize=64)
def _mask(past: int, frames: int, context: int, device: torch.device) -> Tensor:
    """A frame sees itself and the `context` − 1 before it: `[frames, past + frames]`."""
    with torch.inference_mode(False):
        query = torch.arange(past, past + frames, device=device)[:, None]
        key = torch.arange(past + frames, device=device)
        return (key <= query) & (key > query - context)
