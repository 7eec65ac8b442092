"""Episodes from environments: what is recorded, replay, determinism, bad requests."""

import numpy as np
import pytest
from square_world import SIDE

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import PluginError, RecipeError, ShapeError


@pytest.fixture
def square():
    return make_environment("square")


def test_an_episode_holds_what_happened(square):
    episode = simulate(square, EpisodeSpec("square", seed=3))
    assert episode.video.shape == (21, 32, 32, 3)
    assert episode.masks.shape == (21, 32, 32)
    assert episode.actions.shape == (21, 2)
    assert episode.actions.dtype == np.float32
    assert not episode.actions[-1].any()
    assert episode.actions[:-1].any(axis=1).all()
    # The physics, worked out by hand: positions follow from the actions.
    position = episode.states["position"]
    moved = position[0] + np.cumsum(episode.actions[:-1], axis=0, dtype=np.float64)
    inside = np.all((moved > SIDE) & (moved < 32 - SIDE), axis=1)
    until = len(inside) if inside.all() else int(np.argmin(inside))
    assert until > 0
    np.testing.assert_allclose(position[1 : until + 1], moved[:until], atol=1e-4)
    assert (episode.video[episode.masks == 1] == episode.factors["colour"]).all()


def test_contacts_name_frame_and_pair_in_order(square):
    touched = 0
    for index in range(20):
        episode = simulate(square, EpisodeSpec("square", index=index))
        at_wall = np.flatnonzero((episode.states["position"] <= SIDE / 2).any(axis=1))
        np.testing.assert_array_equal(
            episode.contacts, [(t, 1, 2) for t in at_wall] or np.empty((0, 3))
        )
        assert episode.contacts.dtype == np.int32
        touched += len(at_wall)
    assert touched


def test_impossible_requests_are_refused(square):
    with pytest.raises(ShapeError, match="21 or 20 actions, not 5"):
        simulate(square, EpisodeSpec("square"), np.zeros((5, 2)))
    with pytest.raises(ShapeError, match="dx=9"):
        simulate(square, EpisodeSpec("square"), np.full((21, 2), 9.0))
    with pytest.raises(RecipeError, match="colour"):
        simulate(square, EpisodeSpec("square", factors={"color": "ood"}))


def test_environments_that_cannot_be_made_are_refused():
    with pytest.raises(RecipeError, match="did you mean 'square'"):
        make_environment("sqare")
    with pytest.raises(TypeError, match="colour_scheme"):
        make_environment("square", {"colour_scheme": "dark"})
    with pytest.raises(ShapeError, match="multiple of 8"):
        make_environment("square", {"size": 30})
    with pytest.raises(PluginError, match="no_square"):
        make_environment("no_square")
