"""Results that would be broadcast: an error that names the component, and no wrong number."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.errors import PluginError
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_planning.controllers import check_bounds
from tests import tiny
from tests.tiny import BlockCodec, Drift, Slide, SquareEstimator, SumConditioner, ToPlace

VIDEO = torch.zeros(1, 9, 3, 32, 32)


class Codec(BlockCodec):
    """Its results are cut by `encoded` and `decoded`."""

    encoded = decoded = ()

    def _encode(self, video):
        return super()._encode(video)[self.encoded]

    def _decode(self, latents):
        return super()._decode(latents)[self.decoded]


ALL = slice(None)


@pytest.fixture(scope="module", autouse=True)
def parts():
    tiny.register()


@pytest.mark.parametrize(
    ("cuts", "told"),
    [
        ({"encoded": (ALL, slice(1))}, r"Codec._encode gives the shape \[1, 1, 3, 8, 8\], not"),
        ({"encoded": (ALL, ALL, slice(1))}, r"_encode gives the shape \[1, 5, 1, 8, 8\], not"),
        ({"decoded": (ALL, ALL, slice(1))}, r"_decode gives the shape \[1, 9, 1, 32, 32\], not"),
    ],
)
def test_codecs(cuts, told):
    codec = Codec()
    for name, cut in cuts.items():
        setattr(codec, name, cut)
    with pytest.raises(PluginError, match=told):
        codec(VIDEO)


@pytest.mark.parametrize(
    ("cut", "told"),
    [
        ((ALL, slice(1)), r"modulation gives the shape \[1, 1, 4\], not the shape \[1, 5, 4\]"),
        ((..., slice(1)), r"modulation gives the shape \[1, 5, 1\], not the shape \[1, 5, 4\]"),
        (None, "forward gives None, no Conditioning"),
    ],
)
def test_conditioners(cut, told):
    class Conditioner(SumConditioner):
        def forward(self, actions):
            made = super().forward(actions)
            return None if cut is None else replace(made, modulation=made.modulation[cut])

    made = Conditioner(action_size=2, temporal_stride=2, width=4, layers=1, heads=1)
    with pytest.raises(PluginError, match=told):
        made.condition(torch.zeros(1, 9, 2), 5, 4)


def prediction():
    episode = simulate(make_environment("drift"), EpisodeSpec("drift"))
    video = torch.from_numpy(episode.video).permute(0, 3, 1, 2) / 255
    return Prediction.of(episode, video, video, Drift.card)


@pytest.mark.parametrize(
    ("scores", "told"),
    [
        (None, r"per_frame gives the shape \[\], not the shape \["),
        (np.zeros(1), r"per_frame gives the shape \[1\], not the shape \["),
        (np.zeros(8), r"per_frame gives the shape \[8\], not the shape \["),
    ],
)
def test_metrics(scores, told):
    class Given(Metric):
        name = "given"

        def per_frame(self, prediction):
            return scores

    with pytest.raises(PluginError, match=told):
        Given().curve(prediction())


def test_a_weight_counts_no_clip_negatively():
    class Negative(Metric):
        name = "negative"

        def per_frame(self, prediction):
            return np.zeros(len(prediction.target))

        def weight(self, prediction):
            return -1.0

    with pytest.raises(PluginError, match="weight gives -1"):
        Negative().scored(prediction())


def test_actions_of_policies_at_the_door():
    low, high = np.array([-2.0, -2.0]), np.array([2.0, 2.0])
    check_bounds("any", "plan", np.array([2.0, -2.0]), low, high)
    for wrong in ([9.0, 0.0], [np.nan, 0.0]):
        with pytest.raises(PluginError, match="not actions from"):
            check_bounds("any", "plan", np.array(wrong), low, high)


def test_environments_that_hand_out_the_same_arrays_are_recorded_truly():
    class SameArrays(Drift):
        """Hands out the same arrays every time, and changes what it was given."""

        def _start(self, factors, rng):
            super()._start(factors, rng)
            factors["colour"] = 90
            self._shown = None

        def _render(self):
            made = super()._render()
            self._shown = self._shown or made
            for kept, new in zip(self._shown, made, strict=True):
                kept[:] = new
            return self._shown

    spec = EpisodeSpec("drift", factors={"colour": "train"})
    usual, same = simulate(make_environment("drift"), spec), simulate(SameArrays(), spec)
    np.testing.assert_array_equal(same.video, usual.video)
    np.testing.assert_array_equal(same.masks, usual.masks)
    assert same.factors == usual.factors


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_distances_of_tasks_are_finite(value):
    class Lost(ToPlace):
        def distance(self, seen, goal):
            return np.full(len(seen.masks), value)

    environment = TaskEnvironment(Slide(), Lost())
    with pytest.raises(PluginError, match="the distance of task 'place' is"):
        environment.reset(seed=0)


def test_what_an_estimator_reads_is_finite():
    class Lost(SquareEstimator):
        def estimate(self, video):
            seen = super().estimate(video)
            return replace(seen, states={"position": seen.states["position"] + np.inf})

    with pytest.raises(PluginError, match=r"estimate \(position\) is infinite"):
        Lost(Slide.card).read(torch.ones(3, 3, 32, 32))
