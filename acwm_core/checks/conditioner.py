"""`check_conditioner`: what models rely on in a conditioner."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.weights import batch_error, shaken, without_gradient
from acwm_core.conditioner import Conditioner, Conditioning

FIT = {"action_size": 3, "temporal_stride": 4, "width": 16, "layers": 2, "heads": 2}
"""The environment, codec and model that conditioners are fitted to here."""

TOKENS = 5
FAINT = 1e-5
"""Largest difference between effects that count as equal; their own size is about 1."""


class ConditionerTrial:
    """A conditioner whose closed gates were shaken open, and its effect on random tokens.

    Args:
        make: constructs the conditioner; takes the arguments of `FIT`.
    """

    def __init__(self, make: Callable[..., Conditioner]) -> None:
        self.make = make

    @functools.cached_property
    def conditioner(self) -> Conditioner:
        """One instance."""
        return shaken(self.make(**FIT)).eval()

    def actions(self, latent_frames: int = 4, batch: int = 1) -> Tensor:
        """Random actions in [-1, 1] for so many latent frames, `[B, T, A]`."""
        rows = 1 + (latent_frames - 1) * FIT["temporal_stride"]
        generator = torch.Generator().manual_seed(latent_frames)
        return torch.rand(batch, rows, FIT["action_size"], generator=generator) * 2 - 1

    def effect(self, actions: Tensor) -> Tensor:
        """What a model gets: tokens `[B, L, N, D]` after all layers, plus the modulation."""
        conditioning = self.conditioner(actions)
        frames = 1 + (actions.shape[1] - 1) // FIT["temporal_stride"]
        generator = torch.Generator().manual_seed(1)
        tokens = torch.randn(1, 1, TOKENS, FIT["width"], generator=generator)
        tokens = tokens.expand(len(actions), frames, -1, -1)
        for layer in range(FIT["layers"]):
            tokens = conditioning.inject(layer, tokens)
        if conditioning.modulation is not None:
            tokens = tokens + conditioning.modulation.unsqueeze(2)
        return tokens

    def response(self, row: int, latent_frames: int = 4) -> list[float]:
        """How far the effect on each latent frame changes with action `row`."""
        actions = self.actions(latent_frames)
        other = actions.clone()
        other[:, row] = -other[:, row]
        with torch.no_grad():
            change = self.effect(other) - self.effect(actions)
        return [float(frame.abs().max()) for frame in change[0]]


def check_conditioner(
    conditioner: str | Callable[..., Conditioner], **params: Any
) -> Iterator[CheckResult]:
    """Check a conditioner against the contract of `acwm_core.conditioner.Conditioner`.

    Weights are perturbed first: gates that start closed would hide the actions.

    Args:
        conditioner: a registered name, or the class.
        **params: its own constructor parameters, not those that the framework fills in.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    make = functools.partial(factory("conditioner", conditioner), **params)
    return run_checks(CHECKS, ConditionerTrial(make))


def embeds_actions(trial: ConditionerTrial) -> None:
    """Construct the conditioner and embed actions as modulation, context or both."""
    conditioner = trial.conditioner
    expect_is_a(conditioner, Conditioner)
    conditioning = conditioner(trial.actions())
    expect_is_a(conditioning, Conditioning)
    expect(conditioning.conditioner is conditioner, "the Conditioning names another conditioner")
    embedded = (conditioning.modulation, conditioning.context)
    expect(any(e is not None for e in embedded), "it gives neither modulation nor context")


def shapes_follow_the_length(trial: ConditionerTrial) -> None:
    """Give one entry of the model's width per latent frame, whatever the length."""
    for batch, frames in ((1, 1), (2, 2), (1, 5)):
        conditioning = trial.conditioner(trial.actions(frames, batch))
        modulation, context = conditioning.modulation, conditioning.context
        if modulation is not None:
            shape, wanted = list(modulation.shape), [batch, frames, FIT["width"]]
            expect(shape == wanted, f"modulation is {shape}, not [B, L, D] = {wanted}")
        if context is not None:
            shape, wanted = list(context.shape), [batch, frames]
            expect(context.ndim == 4 and shape[:2] == wanted, f"context is {shape}, not [B,L,K,D]")


def tokens_keep_their_shape(trial: ConditionerTrial) -> None:
    """Return finite tokens of the shape they came in, after every layer."""
    actions = trial.actions(batch=2)
    effect = trial.effect(actions)
    wanted = [2, 4, TOKENS, FIT["width"]]
    expect(list(effect.shape) == wanted, f"tokens {wanted} come back {list(effect.shape)}")
    expect(effect.isfinite().all(), "the effect on the tokens is not finite")


def every_action_counts(trial: ConditionerTrial) -> None:
    """Let each action that leads to a frame change something."""
    for row in range(trial.actions().shape[1] - 1):
        expect(max(trial.response(row)) > FAINT, f"action {row} has no effect")


def later_actions_have_no_effect(trial: ConditionerTrial) -> None:
    """Keep actions that start at or after the end of a latent frame out of it."""
    stride = FIT["temporal_stride"]
    for row in range(trial.actions().shape[1]):
        for frame, change in enumerate(trial.response(row)):
            expect(
                change < FAINT or row < frame * stride,
                f"latent frame {frame} ends at video frame {frame * stride}, but action {row}, "
                "which acts later, changes it",
            )


def recent_actions_suffice_if_it_says_so(trial: ConditionerTrial) -> None:
    """With a `history`, embed a latent frame alike without any action before that."""
    conditioner = trial.conditioner
    if conditioner.history is None:
        return
    expect_is_a(conditioner.history, int)
    steps = max(1, conditioner.history) + 1  # what a stream keeps, for its last two latent frames
    actions = trial.actions(latent_frames=steps + 3)
    window = actions[:, -1 - steps * FIT["temporal_stride"] :]
    with torch.no_grad():
        whole, recent = trial.effect(actions), trial.effect(window)
        error = batch_error(whole[:, -2:], recent[:, -2:])
    expect(
        error < FAINT,
        f"the effect changes by {error:.2g} without the actions before its {conditioner.history} "
        "latent steps",
    )


def clips_of_a_batch_are_independent(trial: ConditionerTrial) -> None:
    """Embed a clip alike whatever else is in the batch."""
    actions = trial.actions(batch=2)
    with torch.no_grad():
        error = batch_error(trial.effect(actions)[1:], trial.effect(actions[1:]))
    expect(error < 1e-4, f"the effect changes by {error:.2g} with the rest of the batch")


def gradient_reaches_every_parameter(trial: ConditionerTrial) -> None:
    """Train all parameters: none is idle."""
    left_out = without_gradient(trial.conditioner, trial.effect(trial.actions(batch=2)))
    expect(not left_out, f"no gradient reaches {', '.join(left_out[:3])}")


CHECKS = (
    embeds_actions,
    shapes_follow_the_length,
    tokens_keep_their_shape,
    every_action_counts,
    later_actions_have_no_effect,
    recent_actions_suffice_if_it_says_so,
    clips_of_a_batch_are_independent,
    gradient_reaches_every_parameter,
)
