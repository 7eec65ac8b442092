"""Metrics refuse a prediction that is longer or shorter than the truth, in one sentence."""

from dataclasses import replace

import numpy as np
import pytest

from acwm_core.env.physics import Constant, Gap, Physics, Reading
from acwm_core.errors import ShapeError
from acwm_core.plugins import catalog
from tests.metrics.seeing import boxes, clip

FRAMES = 6
PHYSICS = Physics(
    (Reading("place", "position", ("a", "b")),),
    objects=("a", "b"),
    constants=(Constant("rod", "length", lambda seen, start: seen.states["place"][:, 0, 0], 0.1),),
    gaps=(Gap("pair", ("a", "b"), lambda seen, start: seen.states["place"][:, 1, 0], 0.1, 0.0),),
)


@pytest.fixture(scope="module")
def whole():
    states = {"place": np.ones((FRAMES, 2, 2))}
    return clip(PHYSICS, seen=boxes(FRAMES, (3, 3), (20, 20)), states=states, names="ab")


def state_metrics():
    classes = {each.name: each.load() for each in catalog().registry("metric") if not each.requires}
    needs_files = {"lpips", "fvd"}
    return [
        name
        for name, kind in classes.items()
        if kind.reads == "states" and not kind.of_draws and name not in needs_files
    ]


@pytest.mark.parametrize("name", state_metrics())
@pytest.mark.parametrize("change", ["longer", "shorter", "masks", "states", "empty"])
def test_lengths_that_differ_are_refused(name, change, whole):
    metric = catalog().component("metric", name).create()
    short = {"states": {"place": whole.states["place"][:-1]}, "masks": whole.masks[1:]}
    other = {
        "longer": {"video": whole.video[[*range(FRAMES), 0]]},
        "shorter": {"video": whole.video[:-1]},
        "empty": {"video": whole.video[:0], "target": whole.target[:0]},
    }.get(change) or {change: short[change]}
    with pytest.raises(ShapeError, match=r"of one shape|cut both alike"):
        metric.scored(replace(whole, **other), None)


@pytest.mark.parametrize("frames", [1, 2, 3])
@pytest.mark.parametrize("name", state_metrics())
def test_short_clips_are_scored(name, frames, whole):
    metric = catalog().component("metric", name).create()
    states = {"place": whole.states["place"][:frames]}
    short = clip(PHYSICS, seen=whole.masks[:frames], states=states, names="ab")
    if metric.unavailable(short.card, short.estimator) is None and not metric.of_branches:
        assert metric.curve(short).shape == (frames,)
        value, weight = metric.scored(short)
        assert np.isnan(value) or np.isfinite(value)
        assert weight >= 0
