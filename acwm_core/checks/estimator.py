"""`check_estimator`: what metrics rely on in an estimator."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.environment import Environment
from acwm_core.estimator import StateEstimator
from acwm_core.evaluation.clips import as_clip
from acwm_core.physics import Observation, Physics
from acwm_core.shapes import Clip

FRAMES = 24
"""Frames of the clip that is read."""

LEAST_OVERLAP = 0.5
"""Mean IoU of masks on true frames below which an estimator measures nothing."""


class EstimatorTrial:
    """An estimator and a simulated clip that it reads.

    Args:
        make: constructs the estimator from a card.
        environment: the environment, a name or a class.
    """

    def __init__(
        self,
        make: Callable[..., StateEstimator],
        environment: str | Callable[..., Environment],
    ) -> None:
        self.make = make
        self.environment = EnvironmentTrial(factory("environment", environment), environment)

    @functools.cached_property
    def estimator(self) -> StateEstimator:
        """One instance, for the small frames of the trial."""
        return self.make(card=self.environment.card)

    @functools.cached_property
    def video(self) -> Clip:
        """The first frames of an episode."""
        episode = self.environment.episode
        return as_clip(episode.video[:FRAMES])

    @functools.cached_property
    def observation(self) -> Observation:
        """What the estimator reads in them."""
        return self.estimator.estimate(self.video)

    def truth(self, field: str) -> NDArray[np.float64]:
        """A state field of the clip."""
        return np.asarray(self.environment.episode.states[field][:FRAMES], np.float64)

    @property
    def masks(self) -> NDArray[np.uint8]:
        """The true masks of the instances that are read."""
        names = self.environment.card.instances
        read = [names.index(name) for name in self.estimator.instances]
        masks = self.environment.episode.masks[:FRAMES]
        return np.where(np.isin(masks, read), masks, 0).astype(np.uint8)


def check_estimator(
    estimator: str | Callable[..., StateEstimator],
    environment: str | Callable[..., Environment] | None = None,
    **params: Any,
) -> Iterator[CheckResult]:
    """Check an estimator against the contract of `acwm_core.estimator.StateEstimator`.

    Args:
        estimator: a registered name, or the class.
        environment: what it reads, a registered name or a class; by default the environment of
            the same name.
        **params: constructor parameters beside the card.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: a name cannot be resolved.
        ValueError: a class without an environment.
    """
    if environment is None:
        if not isinstance(estimator, str):
            raise ValueError("say which environment the estimator reads")
        environment = estimator
    make = functools.partial(factory("estimator", estimator), **params)
    return run_checks(CHECKS, EstimatorTrial(make, environment))


def reads_a_clip(trial: EstimatorTrial) -> None:
    """Construct the estimator from a card, and read masks and states of the right shapes."""
    expect_is_a(trial.estimator, StateEstimator)
    card, seen = trial.environment.card, trial.observation
    shape = (len(trial.video), *card.frame_size)
    expect(seen.masks.shape == shape, f"masks are {seen.masks.shape}, not {shape}")
    expect(seen.masks.dtype == np.uint8, f"masks are {seen.masks.dtype}, not uint8")
    shapes = {field.name: field.shape for field in card.state}
    for name, values in seen.states.items():
        expect(name in shapes, f"the card has no state {name!r}")
        wanted = (len(trial.video), *shapes[name])
        expect(values.shape == wanted, f"state {name!r} is {values.shape}, not {wanted}")
        expect(not np.isinf(values).any(), f"state {name!r} is infinite somewhere")


def says_what_it_reads(trial: EstimatorTrial) -> None:
    """List the fields and instances that it reads, and physics that needs no others."""
    estimator, names = trial.estimator, trial.environment.card.instances
    read, listed = sorted(trial.observation.states), sorted(estimator.fields)
    expect(read == listed, f"it lists the fields {listed} and reads {read}")
    unknown = [name for name in estimator.instances if name not in names[1:]]
    expect(not unknown, f"the card has no instance {unknown[:1]} beside the background")
    ids = {names.index(name) for name in estimator.instances} | {0}
    expect(set(np.unique(trial.observation.masks)) <= ids, "masks hold ids that it does not list")
    physics = estimator.physics
    expect_is_a(physics, Physics)
    for reading in physics.readings:
        expect(reading.field in listed, f"its physics needs {reading.field!r}, which is not read")


def tells_instances_apart(trial: EstimatorTrial) -> None:
    """Find the pixels of every instance that is large enough to be seen."""
    masks, seen = trial.masks, trial.observation.masks
    for instance in map(int, np.unique(masks[masks > 0])):
        true, found = masks == instance, seen == instance
        if true.sum() < len(masks) * 20:
            continue  # less than some 20 pixels per frame
        overlap = (true & found).sum() / (true | found).sum()
        name = trial.environment.card.instances[instance]
        expect(overlap >= LEAST_OVERLAP, f"masks of {name!r} have an IoU of {overlap:.2f}")


def follows_what_moves(trial: EstimatorTrial) -> None:
    """Read positions better than a guess that knows where they are on average."""
    for field in _positions(trial.estimator):
        true = trial.truth(field)
        if true.std(0).max() < 1e-3:
            continue  # nothing moves by more than a millimetre
        error = np.nanmean(np.abs(trial.observation.states[field] - true))
        guess = np.abs(true - true.mean(0)).mean()
        expect(
            error < guess, f"{field!r} is off by {error:.3g} m, its mean position by {guess:.3g} m"
        )


def shows_positions_in_the_frame(trial: EstimatorTrial) -> None:
    """Put positions where they appear, in pixels of the frame."""
    height, width = trial.environment.card.frame_size
    for field in _positions(trial.estimator):
        true = trial.truth(field)
        there = trial.estimator.pixels(field, true)
        wanted = (*true.shape[:-1], 2)
        expect(there.shape == wanted, f"pixels of {field!r} are {there.shape}, not {wanted}")
        inside = (there >= -0.5 * height) & (there <= [1.5 * width, 1.5 * height])
        expect(inside.all(), f"{field!r} appears far out of the frame")


def reads_frames_of_every_size(trial: EstimatorTrial) -> None:
    """Read larger frames as it reads these, and refuse those that are not the card's."""
    height, width = (2 * side for side in trial.environment.card.frame_size)
    card = replace(trial.environment.card, frame_size=(height, width))
    video = torch.nn.functional.interpolate(trial.video[:2], (height, width), mode="bilinear")
    masks = trial.make(card=card).estimate(video).masks
    expect(masks.shape == (2, height, width), f"twice as large frames get masks {masks.shape}")
    try:
        trial.estimator.estimate(video)
    except ValueError:
        return
    expect(False, "it reads frames that are not of the card's size")


def reading_repeats_and_leaves_no_trace(trial: EstimatorTrial) -> None:
    """Read the same twice, without a change to the video."""
    video = trial.video.clone()
    again = trial.estimator.estimate(trial.video)
    expect(torch.equal(video, trial.video), "it changes the video that it is given")
    expect(np.array_equal(again.masks, trial.observation.masks), "a second reading's masks differ")
    for name, values in trial.observation.states.items():
        same = np.array_equal(values, again.states[name], equal_nan=True)
        expect(same, f"a second reading of {name!r} differs")


def _positions(estimator: StateEstimator) -> list[str]:
    return [each.field for each in estimator.physics.readings if each.kind == "position"]


CHECKS = (
    reads_a_clip,
    says_what_it_reads,
    tells_instances_apart,
    follows_what_moves,
    shows_positions_in_the_frame,
    reads_frames_of_every_size,
    reading_repeats_and_leaves_no_trace,
)
