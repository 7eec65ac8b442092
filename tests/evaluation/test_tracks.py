"""Tracks of what a model sees, in a world that it knows exactly."""

import numpy as np
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.evaluation.clips import Clip
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.tracks import tracks_of
from acwm_core.training.run import load_run
from tests import tiny


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    tiny.register()
    data = tmp_path_factory.mktemp("tracks") / "data"
    generate("slide", data, episodes={"ind_test": 1}, workers=0, progress=False)
    return Prediction.truth(EpisodeDataset(data, "ind_test")[0], tiny.Slide.card, clip=Clip())


def test_tracks_are_places_in_the_picture(truth, tmp_path):
    world = load_run(tiny.make_exact_run(tmp_path / "run", "sighted")).world_model
    found = tracks_of(world, truth)
    middles = (truth.states["position"][::4, ::-1] + tiny.SIDE / 2) / 32
    assert found.names == ["square"]  # the picture does not care for the other
    assert (found.shares, found.every) == ([1.0], 4)
    for places in (found.seen, found.predicted):
        np.testing.assert_allclose(np.array(places)[:, 0], middles, atol=1.2 / 32)


def test_other_models_have_none(truth, tmp_path):
    world = load_run(tiny.make_exact_run(tmp_path / "run")).world_model
    assert tracks_of(world, truth) is None
    assert tracks_of(object(), truth) is None  # such as predictions in files
