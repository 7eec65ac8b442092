"""The driver of `acwm play` decides as the controller of `acwm plan` does."""

import numpy as np
import pytest

from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_planning.controllers import PlanningController
from acwm_planning.futures import History, ModelRollouts
from acwm_planning.run import make_cost, make_planner
from acwm_planning.settings import settings_of
from acwm_play.driver import Driver
from tests import tiny

FEW = (
    *("planner.candidates=16", "planner.elites=4", "planner.iterations=2", "planner.horizon=1"),
    "past=1",
)


class Quick(tiny.ToPlace):
    planning = FEW


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    tiny.register()
    return load_run(tiny.make_slide_run(tmp_path_factory.mktemp("planning")))


@pytest.fixture
def driver(bundle):
    given = {"world_model": bundle.world_model, "card": bundle.card, "task": Quick()}
    return (
        catalog().component("driver", "planner").create_as(Driver, **given, action_std=[0.5, 0.5])
    )


@pytest.fixture
def history():
    made = tiny.task_environment()
    frame, info = made.reset(options={"spec": tiny.spec(0)})
    found = History(tiny.spec(0), [frame])
    for _ in range(9):
        action = np.array([1.0, -0.5], np.float32)
        found.frames.append(made.step(action)[0])
        found.actions.append(action)
    return found, info["goal"], made.environment.still_action()


def test_it_decides_as_acwm_plan_does(bundle, driver, history):
    seen, goal, still = history
    settings = settings_of([], declared=FEW)
    cost = make_cost(settings)
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None, **settings.rollouts(cost))
    planned = PlanningController(make_planner(settings), rollouts, cost, action_std=[0.5, 0.5])
    planned.aim(Quick(), goal, bundle.card.action, still, 7)
    driver.begin(goal, still, 7)
    checks = []
    for _ in range(2):
        made = driver.act(seen.frames, seen.actions, lambda: checks.append(1))
        np.testing.assert_array_equal(made, planned.act(seen))
    assert len(checks) == 4  # before the candidates of every iteration


def test_it_ends_when_its_check_raises(driver, history):
    seen, goal, still = history

    def check():
        raise TimeoutError("nobody waits")

    driver.begin(goal, still, 0)
    with pytest.raises(TimeoutError, match="nobody waits"):
        driver.act(seen.frames, seen.actions, check)


def test_steps_of_the_page_come_before_the_tasks(bundle):
    class Slow(tiny.ToPlace):
        planning = ("steps=0",)

    given = {"world_model": bundle.world_model, "card": bundle.card, "task": Slow()}
    component = catalog().component("driver", "planner")
    assert isinstance(component.create(**given, steps=2), Driver)
    with pytest.raises(RecipeError, match="steps=0: give 1 or more"):
        component.create(**given)
