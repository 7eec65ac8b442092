"""`Batch`: clips as objectives get them, and the random numbers that belong to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Latent


@dataclass(frozen=True)
class Batch:
    """Clips of a batch: to learn from, or their beginning, to be continued.

    Attributes:
        latents: clean latent frames `[B, L, C, h, w]`; of a beginning, the given ones alone.
        conditioning: the embedded actions of whole clips.
        generators: one CPU generator per clip, the only source of randomness.
        states: what to learn of the scene in each video frame, `[B, T, S]`, as it was recorded.
            None if there is nothing.
        weights: how much the error of each latent frame counts, `[B, L]`; None if all count alike.
    """

    latents: Latent
    conditioning: Conditioning
    generators: Sequence[torch.Generator]
    states: Tensor | None = None
    weights: Tensor | None = None

    def noise(self, frames: int) -> Latent:
        """Standard normal noise `[B, frames, C, h, w]`, of the latents' type and device."""
        shape = (frames, *self.latents.shape[2:])
        return to_device(noise_of_clips(shape, self.generators), self.latents)

    def random_frames(self, frames: int, among: int) -> Tensor:
        """Numbers of so many frames of each clip, drawn at random from the first `among`.

        `[B, N]`, with N = `frames`, or `among` if that is fewer.
        """
        orders = [torch.randperm(among, generator=generator) for generator in self.generators]
        return to_device(torch.stack(orders)[:, :frames], self.latents, torch.int64)


def weighed(errors: Tensor, weights: Tensor | None) -> Tensor:
    """Errors of the last latent frames of clips, `[B, N]`, times the weights of these frames.

    Args:
        errors: one for each frame.
        weights: those of all latent frames, `[B, L]`; None leaves the errors as they are.
    """
    return errors if weights is None else errors * weights[:, -errors.shape[1] :].to(errors)


def noise_of_clips(shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Standard normal noise `[B, *shape]` on the CPU; each clip has its own generator."""
    return torch.stack([torch.randn(tuple(shape), generator=generator) for generator in generators])


def to_device(tensor: Tensor, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """A tensor of the CPU on the device of another, and in its type unless one is given.

    An accelerator copies it from page-locked memory when it comes to it, so the program goes on.
    (Apple's cannot be trusted with that.)
    """
    converted = tensor.to(dtype or like.dtype)
    if like.device.type in ("cpu", "mps", "meta"):
        return converted.to(like.device)
    return converted.pin_memory().to(like.device, non_blocking=True)
