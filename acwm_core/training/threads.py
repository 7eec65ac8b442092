"""Finds how many CPU threads train fastest, by trying with the model under the current load."""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, cast

import lightning as L
import torch

from acwm_core.errors import noting
from acwm_core.model.world_model import WorldModel
from acwm_core.training.data_module import ClipData
from acwm_core.training.task import check_gradient

SECONDS = 1.0
"""How long each number of threads is tried, if a step takes less."""


def found_threads(trainer: L.Trainer, world_model: WorldModel, data: ClipData) -> int | None:
    """The fastest number of threads for clips of the size that training will use.

    It is that of OMP_NUM_THREADS, if that is set, and None on GPUs and for many processes.
    """
    if trainer.strategy.root_device.type != "cpu" or trainer.world_size > 1:
        return None
    if "OMP_NUM_THREADS" in os.environ:
        return torch.get_num_threads()
    clips = data.config.batch_size, data.frames
    size = data.episodes.card.environment.frame_size
    precision = cast(Any, trainer).precision_plugin.forward_context
    with noting("while numbers of threads were tried", *world_model.children()):
        return fastest_threads(world_model, clips, size, precision)


def fastest_threads(
    world_model: WorldModel,
    clips: tuple[int, int],
    frame_size: tuple[int, int],
    precision: Callable[[], AbstractContextManager[Any]],
) -> int:
    """The fastest number of threads among PyTorch's current one, half of it, and so on.

    A step computes the loss and gradients of a batch of zero latents. The model, PyTorch's number
    of threads and its random state are left unchanged.

    Args:
        world_model: on the CPU.
        clips: batch size, and number of frames per clip.
        frame_size: H and W.
        precision: creates the trainer's precision context, in which the loss is computed.

    Raises:
        TrainingError: the loss has no gradient.
    """
    codec, usual = world_model.codec, torch.get_num_threads()
    if usual == 1:
        return 1
    batch_size, frames = clips
    length, size = codec.latent_frames(frames), codec.latent_size(*frame_size)
    latents = torch.zeros(batch_size, length, codec.channels, *size)
    actions = world_model.action_low.expand(batch_size, frames, -1)
    tried = copy.deepcopy(world_model, {id(codec): codec}).train()
    generators = [torch.Generator() for _ in range(batch_size)]

    def step() -> None:
        with precision():
            loss = tried.loss(latents, actions, generators)
        check_gradient(loss, tried)
        cast(Any, loss).backward()

    best, least = usual, math.inf
    with cast(Any, torch.random).fork_rng(devices=[]):
        try:
            for halvings in range(usual.bit_length()):
                torch.set_num_threads(usual >> halvings)
                seconds = _seconds_per(step)
                if seconds > 1.5 * least:  # fewer will hardly be faster
                    break
                if seconds < least:
                    best, least = usual >> halvings, seconds
        finally:
            torch.set_num_threads(usual)
    return best


def _seconds_per(step: Callable[[], None]) -> float:
    """The mean time of steps without the first, which is slower, unless that one is long."""
    first = _seconds_of(step)
    if first > SECONDS:
        return first
    taken = [_seconds_of(step)]
    while sum(taken) < SECONDS:
        taken.append(_seconds_of(step))
    return sum(taken) / len(taken)


def _seconds_of(step: Callable[[], None]) -> float:
    started = time.monotonic()
    step()
    return time.monotonic() - started
