"""`Batch`: what an objective and its model learn from, and the noise that belongs to its clips."""

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
        states: the agent's states in each latent frame, to learn from, `[B, L, S]`, each value with
            mean 0 and deviation 1 over the training data, but for a model that takes raw ones
            (`Predictor.raw_states`); of each video frame, if it follows them
            (`Predictor.follows_states`). None if there are none.
    """

    latents: Latent
    conditioning: Conditioning
    generators: Sequence[torch.Generator]
    states: Tensor | None = None

    def noise(self, frames: int) -> Latent:
        """Standard normal noise `[B, frames, C, h, w]`, of the latents' type and device."""
        return sent(drawn_noise((frames, *self.latents.shape[2:]), self.generators), self.latents)

    def picked(self, frames: int, among: int) -> Tensor:
        """Numbers of so many frames of each clip, drawn at random from the first `among`.

        `[B, N]`, with N = `frames`, or `among` if that is fewer.
        """
        orders = [torch.randperm(among, generator=each) for each in self.generators]
        return sent(torch.stack(orders)[:, :frames], self.latents, torch.int64)


def drawn_noise(shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Standard normal noise `[B, *shape]` on the CPU; each clip has its own generator."""
    return torch.stack([torch.randn(tuple(shape), generator=each) for each in generators])


def sent(tensor: Tensor, to: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """A tensor of the CPU on the device of another, and in its type unless one is given.

    An accelerator copies it from page-locked memory when it comes to it, so the program goes on.
    (Apple's cannot be trusted with that.)
    """
    made = tensor.to(dtype or to.dtype)
    if to.device.type in ("cpu", "mps", "meta"):
        return made.to(to.device)
    return made.pin_memory().to(to.device, non_blocking=True)
