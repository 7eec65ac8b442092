"""Finds how many CPU threads train fastest, by trying with the model under the current load."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, cast

import torch

from acwm_core.world_model import WorldModel

SECONDS = 1.0
"""How long each number of threads is tried."""


def fastest_threads(
    world_model: WorldModel,
    clips: tuple[int, int],
    frame_size: tuple[int, int],
    precision: Callable[[], AbstractContextManager[Any]],
) -> int:
    """The number of threads that does most steps per second: PyTorch's current one, half of it, ...

    A step computes the loss and gradients of a batch of zero latents. The model, PyTorch's number
    of threads and its random state are left unchanged.

    Args:
        world_model: on the CPU.
        clips: batch size, and number of frames per clip.
        frame_size: H and W.
        precision: creates the trainer's precision context, in which the loss is computed.
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
