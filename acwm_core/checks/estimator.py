"""Checks of an estimator: what metrics require of it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.checks.result import Checked, Suite, expect, expect_equal, expect_is_a
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.env.episode import Episode
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.shapes import Clip


class EstimatorChecks(Suite):
    """Checks of an `acwm_core.env.physics.StateEstimator` on a simulated clip of small frames.

    Args:
        environment: the environment it reads, a registered name or a class; by default the
            environment of the same name.

    Raises:
        ValueError: the estimator is given as a class, without an environment.
    """

    kind = "estimator"

    def __init__(
        self, component: Checked, environment: Checked | None = None, **params: Any
    ) -> None:
        super().__init__(component, **params)
        if environment is None and not isinstance(component, str):
            raise ValueError("say which environment the estimator reads")
        self._environment = EnvironmentTrial(environment or component)

    @functools.cached_property
    def _estimator(self) -> StateEstimator:
        return self.make(card=self._environment.card)

    @property
    def _episode(self) -> Episode:
        return self._environment.beginning

    @functools.cached_property
    def _video(self) -> Clip:
        return as_clip(self._episode.video)

    @functools.cached_property
    def _observation(self) -> Observation:
        return self._estimator.estimate(self._video)

    def _positions(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        states = self._episode.states
        for reading in self._estimator.physics.readings:
            if reading.kind == "position":
                yield reading.field, np.asarray(states[reading.field], np.float64)

    def reads_a_clip(self) -> None:
        """Construct the estimator from a card, and read masks and states of the right shapes."""
        expect_is_a(self._estimator, StateEstimator)
        card, seen, frames = self._environment.card, self._observation, len(self._video)
        expect_equal("masks are", seen.masks.shape, (frames, *card.frame_size))
        expect_equal("masks are", seen.masks.dtype, np.dtype(np.uint8))
        shapes = {field.name: field.shape for field in card.state}
        for name, values in seen.states.items():
            expect(name in shapes, f"the card has no state {name!r}")
            expect_equal(f"state {name!r} is", values.shape, (frames, *shapes[name]))
            expect(not np.isinf(values).any(), f"state {name!r} is infinite somewhere")

    def says_what_it_reads(self) -> None:
        """List the fields and instances that it reads; its physics must need no others."""
        estimator, names = self._estimator, self._environment.card.instances
        read, listed = sorted(self._observation.states), sorted(estimator.fields)
        expect(read == listed, f"it lists the fields {listed} and reads {read}")
        unknown = [name for name in estimator.instances if name not in names[1:]]
        expect(not unknown, f"the card has no instance {unknown[:1]} beside the background")
        ids = {0, *map(names.index, estimator.instances)}
        ids_in_masks = set(np.unique(self._observation.masks))
        expect(ids_in_masks <= ids, "masks hold ids that it does not list")
        expect_is_a(estimator.physics, Physics)
        for field in (reading.field for reading in estimator.physics.readings):
            expect(field in listed, f"its physics needs {field!r}, which is not read")

    def tells_instances_apart(self) -> None:
        """Find the pixels of every instance that is large enough to be visible."""
        masks = self._episode.masks
        for name in self._estimator.instances:
            instance = self._environment.card.instances.index(name)
            true, read = masks == instance, self._observation.masks == instance
            if true.sum() >= 20 * len(masks):
                overlap = (true & read).sum() / (true | read).sum()
                expect(overlap >= 0.5, f"masks of {name!r} have an IoU of {overlap:.2f}")

    def follows_what_moves(self) -> None:
        """Read positions more accurately than by guessing their mean."""
        for field, true in self._positions():
            if true.std(0).max() < 1e-3:
                continue  # nothing moves by more than a millimetre
            error = np.nanmean(np.abs(self._observation.states[field] - true))
            guess = np.abs(true - true.mean(0)).mean()
            off = f"{field!r} is off by {error:.3g} m, its mean position by {guess:.3g} m"
            expect(error < guess, off)

    def shows_positions_in_the_frame(self) -> None:
        """Convert positions to where they appear, in pixels of the frame."""
        height, width = self._environment.card.frame_size
        for field, true in self._positions():
            there = self._estimator.pixels(field, true)
            expect_equal(f"pixels of {field!r} are", there.shape, (*true.shape[:-1], 2))
            inside = (there >= -0.5 * height) & (there <= [1.5 * width, 1.5 * height])
            expect(inside.all(), f"{field!r} appears far outside the frame")

    def reads_frames_of_every_size(self) -> None:
        """Read larger frames, too, and refuse frames that do not have the card's size."""
        height, width = (2 * side for side in self._environment.card.frame_size)
        card = replace(self._environment.card, frame_size=(height, width))
        video = torch.nn.functional.interpolate(self._video[:2], (height, width), mode="bilinear")
        masks = self.make(card=card).estimate(video).masks
        expect(masks.shape == (2, height, width), f"twice as large frames get masks {masks.shape}")
        try:
            self._estimator.estimate(video)
        except ValueError:
            return
        expect(False, "it reads frames that are not of the card's size")

    def reading_repeats_and_leaves_no_trace(self) -> None:
        """Give the same result twice, without changing the video."""
        first, video = self._observation, self._video.clone()
        second = self._estimator.estimate(self._video)
        expect(torch.equal(video, self._video), "it changes its input video")
        expect(np.array_equal(second.masks, first.masks), "a second reading's masks differ")
        for name, values in first.states.items():
            same = np.array_equal(values, second.states[name], equal_nan=True)
            expect(same, f"a second reading of {name!r} differs")
