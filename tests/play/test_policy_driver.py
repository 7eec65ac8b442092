"""The driver of `acwm play` that lets a trained policy act."""

import numpy as np
import pytest

from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from acwm_planning.policies.saved import default_folder
from acwm_play.driver import Driver
from tests import tiny
from tests.learning import world


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """Creates the driver in a folder with or without policies."""
    tiny.register()
    monkeypatch.chdir(tmp_path)
    card = tiny.task_environment().environment.card

    def create():
        component = catalog().component("driver", "trained_policy")
        given = {"world_model": None, "action_std": None, "steps": None}
        return component.create_as(Driver, card=card, task=tiny.PLACE, **given)

    return create


def test_it_reaches_the_goal_from_pictures(drive):
    default_folder("slide").parent.mkdir(parents=True)
    world.straight(default_folder("slide.place"))
    environment = tiny.task_environment()
    frame, info = environment.reset(options={"spec": tiny.spec(0)})
    driver, frames, actions = drive(), [frame], []
    driver.begin(info["goal"], environment.environment.still_action(), 0)
    decisions = 0
    while not info["success"] and decisions < 6:
        decisions += 1
        for action in driver.act(frames, actions, lambda: None):
            frame, *_, info = environment.step(np.asarray(action, np.float32))
            frames.append(frame)
            actions.append(action)
    assert info["success"]


def test_without_a_policy_it_says_how_to_train_one(drive):
    with pytest.raises(RecipeError, match=r"acwm policy train slide\.place"):
        drive()
