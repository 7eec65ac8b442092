"""A model with points as the start of another one, on other data."""

import pytest
import torch

from acwm_core.errors import TrainingError
from acwm_core.training.run import load_weights, save_weights
from acwm_scene.point_training import learn_points, pair_loss
from tests.scene.dots import world_of
from tests.scene.test_points import balls, clips_of, model_of_balls

OTHER = 0.3
"""By how much the pictures of the other data are brighter."""


def written(world, path):
    save_weights(path, world.state_dict(), world.codec.latents_fingerprint(), 1)
    return path


def test_points_go_on_learning_on_other_data(tmp_path):
    first = world_of(model_of_balls(), stride=1)
    learn_points(first.model, clips_of(balls(32, seed=1)[0]), 15)
    file, losses = written(first, tmp_path / "w.safetensors"), []
    others = clips_of(balls(32, seed=2)[0] + OTHER)
    for start in (None, file):
        torch.manual_seed(5)
        world = world_of(model_of_balls(), stride=1)
        if start:
            load_weights(world, start)
        learn_points(world.model, others, 2)
        average = others.latents(torch.arange(32)).mean((0, 1))
        seen = torch.nn.functional.adaptive_avg_pool2d(world.model.points.sight.average, 8)
        torch.testing.assert_close(seen, average)  # of this data
        with torch.no_grad():
            random = torch.Generator().manual_seed(0)
            losses.append(float(pair_loss(world.model.eval(), others, random)))
    assert losses[1] < losses[0]


def test_another_number_of_points_is_refused(tmp_path):
    file = written(world_of(model_of_balls(), stride=1), tmp_path / "w.safetensors")
    with pytest.raises(TrainingError, match=r"not fit the recipe: model\.groups") as said:
        load_weights(world_of(model_of_balls(points=6), stride=1), file)
    assert "\n" not in str(said.value)
