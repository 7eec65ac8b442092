"""How many threads to train with on a CPU: tried with the model, beside whatever else runs."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, cast

import torch

from acwm_core.world_model import WorldModel

SECONDS = 1.0
"""For which each number of threads is tried."""


def fastest_threads(
    world_model: WorldModel,
    clips: tuple[int, int],
    frame_size: tuple[int, int],
    precision: Callable[[], AbstractContextManager[Any]],
) -> int:
    """The number of threads, of PyTorch's own, half of that and so on, that does most steps.

    A step is the loss and gradients of a batch of noise; the model, PyTorch's number of threads and
    its random numbers stay as they are.

    Args:
        world_model: on the CPU.
        clips: how many of them make a batch, and of how many frames they are.
        frame_size: H and W.
        precision: makes the trainer's context, in which the loss is computed.
    """
    codec, usual = world_model.codec, torch.get_num_threads()
    batch_size, frames = clips
    length, size = codec.latent_frames(frames), codec.latent_size(*frame_size)
    latents = torch.zeros(batch_size, length, codec.channels, *size)
    actions = world_model.action_low.expand(batch_size, frames, -1)
    tried = copy.deepcopy(world_model).train()
    generators = [torch.Generator() for _ in range(batch_size)]

    def step() -> None:
        with precision():
            loss = tried.loss(latents, actions, generators)
        cast(Any, loss).backward()

    def steps_per_second() -> float:
        step()  # the first one is slower
        started, steps = time.monotonic(), 0
        while not steps or time.monotonic() - started < SECONDS:
            step()
            steps += 1
        return steps / (time.monotonic() - started)

    rates: dict[int, float] = {}
    with cast(Any, torch.random).fork_rng(devices=[]):
        try:
            for halvings in range(usual.bit_length()):
                torch.set_num_threads(usual >> halvings)
                rates[usual >> halvings] = steps_per_second()
        finally:
            torch.set_num_threads(usual)
    return max(rates, key=lambda threads: rates[threads])
