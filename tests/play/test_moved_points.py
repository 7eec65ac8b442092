"""Things that the model sees, moved by a person in its picture."""

import numpy as np
import pytest
import torch

from acwm_core.checks.trial import shaken
from acwm_core.errors import RecipeError
from acwm_play.live_model import LiveModel
from acwm_scene.scene import SceneDynamics
from tests.play.test_spread import ACTIONS, CARD
from tests.scene.dots import world_codec, world_of


@pytest.fixture
def played():
    torch.manual_seed(0)
    sizes = {"channels": 8, "width": 8, "blocks": 1, "temporal_stride": 4}
    model = SceneDynamics(
        specs={}, points=3, state_size=0, latent_channels=world_codec().channels, **sizes
    )
    model.points.measure(torch.randn(32, 3, 6), torch.ones(3, 6))
    return LiveModel(world_of(shaken(model)).eval(), CARD, None)


def test_a_point_that_is_dragged_is_where_it_was_put(played):
    frame = np.random.default_rng(0).integers(0, 256, (1, *CARD.frame_size, 3), np.uint8)
    played.restart(frame, [])
    assert [number for number, *_ in played.keypoints] == [0, 1, 2]
    before = played.keypoints
    undisturbed = played.step(ACTIONS)
    played.restart(frame, [])
    played.move(1, [0.25, 1.5])  # beyond the border: at the border
    assert played.keypoints == [before[0], (1, 0.25, 1.0), before[2]]
    assert (played.step(ACTIONS) != undisturbed).any()
    played.restart(frame, [])
    assert played.keypoints == before


def test_a_thing_that_is_not_there_cannot_be_moved(played):
    with pytest.raises(RecipeError, match="3 things to move"):
        played.move(3, [0.5, 0.5])
