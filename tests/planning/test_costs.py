"""Costs of futures that are known."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal
from acwm_core.errors import AcwmError, RecipeError
from acwm_core.model.dynamics import Keypoints
from acwm_core.plugins import catalog
from acwm_planning.costs import (
    KeypointDistance,
    LatentDistance,
    StateDistance,
    UserCost,
    last_frames,
)
from acwm_planning.planner import Cost, Futures
from acwm_planning.predicted import observation_of
from tests import tiny
from tests.planning.problems import planned, quadratic


class Known(Futures):
    """Three candidates, four frames: latents and places are numbers that the test can tell."""

    length = 4

    def __init__(self, places):
        self.places = np.asarray(places, float)  # [N, 4, 2]

    def latents(self, frames):
        values = torch.tensor(self.places[:, list(frames)]).float()
        return values[:, :, None, None]

    def video(self, frames):
        raise AssertionError("no picture is needed")

    def observe(self, frames):
        places = self.places[:, list(frames)].reshape(-1, 2)
        return Observation(np.zeros((len(places), 8, 8), np.uint8), {"position": places})

    def still(self, picture):
        return torch.full((1, 1, 1, 1, 2), 14.0)


PLACES = np.stack([np.full((4, 2), 14.0), np.full((4, 2), 17.0), np.full((4, 2), 14.0)])
PLACES[2, :3] = 20.0

GOAL = Goal({"position": np.array([14.0, 14.0])}, np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3)))


@pytest.mark.parametrize(("frames", "wanted"), [(None, [0, 9, 27]), (1, [0, 9, 0])])
def test_the_distance_of_latents(frames, wanted):
    found = LatentDistance(frames=frames)(Known(PLACES), tiny.PLACE, GOAL)
    torch.testing.assert_close(found, torch.tensor(wanted).float())


@pytest.mark.parametrize(("frames", "share"), [(None, 0.75), (2, 0.5), (1, 0.0)])
def test_the_distance_of_states(frames, share):
    """In tolerances of the task, 1.5 px."""
    found = StateDistance(frames=frames)(Known(PLACES), tiny.PLACE, GOAL)
    far = math.hypot(6, 6) / 1.5
    torch.testing.assert_close(found, torch.tensor([0, math.hypot(3, 3) / 1.5, share * far]))


def test_a_failure_on_the_way_costs():
    places = PLACES.copy()
    places[0, 0, 1] = 3.0  # in the forbidden half
    usual, shy = (
        StateDistance(frames=None, failure=100)(Known(places), t, GOAL)
        for t in (tiny.PLACE, tiny.SHY)
    )
    torch.testing.assert_close(shy - usual, torch.tensor([100.0, 0, 0]))


@pytest.mark.parametrize("unknown", [10.0, 0.0])
def test_frames_with_an_unknown_distance_are_penalised(unknown):
    places = PLACES.copy()
    places[1, :3], places[2] = math.nan, math.nan
    found = StateDistance(frames=None, unknown=unknown)(Known(places), tiny.PLACE, GOAL)
    assert float(found[1]) == pytest.approx(math.hypot(3, 3) / 1.5 + unknown * 3 / 4)
    assert float(found[2]) == pytest.approx(math.hypot(3, 3) / 1.5 + unknown)  # none at all
    nothing = StateDistance(frames=None, unknown=unknown)(
        Known(np.full_like(places, math.nan)), tiny.PLACE, GOAL
    )
    torch.testing.assert_close(nothing, torch.full((3,), unknown))


def fields_of(values, name):
    return observation_of({name: np.asarray(values)}, len(values))


class Predicted(Known):
    """Of a model that says that all is at (14, 14), whatever the pictures show."""

    name = "position"

    def predicted(self, frames):
        return fields_of(torch.full((3 * len(frames), 2), 14.0), self.name)


class Elsewhere(Predicted):
    name = "speed"


@pytest.mark.parametrize("read", ["pictures", "model", None])
def test_states_are_the_model_s_own_where_it_predicts_them(read):
    pictures = StateDistance(frames=1)(Known(PLACES + 3), tiny.PLACE, GOAL)
    found = StateDistance(frames=1, read=read)(Predicted(PLACES + 3), tiny.PLACE, GOAL)
    assert found.equal(pictures if read == "pictures" else torch.zeros(3))


def test_what_a_model_does_not_predict_is_read_from_pictures():
    pictures = StateDistance(frames=1)(Known(PLACES), tiny.PLACE, GOAL)
    assert StateDistance(frames=1)(Elsewhere(PLACES), tiny.PLACE, GOAL).equal(pictures)
    with pytest.raises(RecipeError, match="predicts speed, but the task needs position: set"):
        StateDistance(read="model")(Elsewhere(PLACES), tiny.PLACE, GOAL)
    with pytest.raises(RecipeError, match=r"predicts no states: set cost\.read=pictures"):
        StateDistance(read="model")(Known(PLACES), tiny.PLACE, GOAL)
    with pytest.raises(RecipeError, match="give model, pictures or null"):
        StateDistance(read="both")


class Half(Predicted):
    """Of a model that does not know the second coordinate."""

    def predicted(self, frames):
        states = torch.full((3 * len(frames), 2), 14.0)
        states[:, 1] = torch.nan
        return fields_of(states, self.name)


def test_what_a_model_predicts_in_part_is_read_from_pictures():
    """And not planned by without a distance."""
    pictures = StateDistance(frames=1)(Known(PLACES), tiny.PLACE, GOAL)
    assert StateDistance(frames=1)(Half(PLACES), tiny.PLACE, GOAL).equal(pictures)
    with pytest.raises(RecipeError, match="no distance can be computed from what"):
        StateDistance(read="model")(Half(PLACES), tiny.PLACE, GOAL)


@pytest.mark.parametrize("look", [lambda m: m == 1, lambda m: m[0], lambda m: np.asarray(m).sum()])
def test_a_model_that_predicts_states_predicts_no_masks(look):
    """A task that looks at masks gets those of pictures, and no empty ones."""
    seen = fields_of(torch.zeros(3, 2), "position")
    assert len(seen.masks) == 3
    with pytest.raises(RecipeError, match="the task needs masks"):
        look(seen.masks)


def test_frames_that_are_judged_end_with_the_last():
    assert last_frames(7, 1) == [6]
    assert last_frames(7, 3) == [2, 4, 6]
    assert last_frames(7, None) == list(range(7)) == last_frames(7, 99)
    for cost in (LatentDistance, StateDistance):
        with pytest.raises(RecipeError, match="frames=0"):
            cost(frames=0)


def test_a_function_of_the_user_s(tmp_path, monkeypatch):
    text = "def far(futures, task, goal):\n    return futures.places[:, -1, 0] - 14"
    (tmp_path / "my_costs.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    cost = catalog().component("cost", "callable").create_as(Cost, function="my_costs:far")
    assert cost(Known(PLACES), tiny.PLACE, GOAL).tolist() == [0, 3, 0]
    for wrong in ("my_costs", "my_costs:missing", "no_such_module:far", "math:pi"):
        with pytest.raises(AcwmError, match=f"cost.function={wrong}"):
            UserCost(function=wrong)


def code(document, name):
    """What the block of a document defines under a name."""
    text = (Path(__file__).parents[2] / document).read_text()
    (block,) = [b for b in re.findall(r"```python\n(.*?)```", text, re.S) if f" {name}(" in b]
    space = {}
    exec(block, space)
    return space[name]


def test_what_the_documents_show_works():
    cost = code("docs/reference/planning.md", "LastDistance")()
    assert cost(Known(PLACES), tiny.PLACE, GOAL).tolist() == [0, pytest.approx(math.hypot(3, 3)), 0]
    planner = code("docs/reference/planning.md", "HillClimbing")(candidates=300, horizon=2)
    plan = planned(planner, quadratic(torch.tensor([0.5, 0.4])))
    assert plan.evaluations == 300
    torch.testing.assert_close(
        plan.actions, torch.tensor([0.5, 0.4]).expand(8, 2), atol=0.2, rtol=0
    )

    class Seen(Known):
        def video(self, frames):
            return torch.zeros(3, len(frames), 3, 8, 8)

    gently = code("docs/planning.md", "gently")
    assert gently(Seen(PLACES), tiny.PLACE, GOAL).tolist() == [0, pytest.approx(4.243, 1e-3), 0]


class Seen(Known):
    """Of a model that sees two keypoints: one where the candidate is, and one that rests."""

    def keypoints(self, frames):
        values = torch.tensor(self.places[:, list(frames)]).float()
        values = torch.stack([torch.nn.functional.pad(values, (0, 1)), torch.zeros(3, 4, 3)], 2)
        return Keypoints(values, torch.tensor([[1.0, 1, 5], [1, 1, 1]]), torch.ones(2))

    def keypoints_of(self, picture):
        values = torch.tensor([[14.0, 14, 1], [math.nan, 0, 0]])[None, None]
        return Keypoints(values, torch.ones(2, 3), torch.ones(2))


def test_points_count_by_their_weights_and_not_where_they_are_not_seen():
    found = KeypointDistance(frames=None, features=0)(Seen(PLACES), None, GOAL)
    far = [0, math.hypot(3, 3), 3 * math.hypot(6, 6) / 4]
    torch.testing.assert_close(found, torch.tensor(far), atol=5e-3, rtol=0)
    found = KeypointDistance(frames=None)(Seen(PLACES), None, GOAL)
    assert float(found[0]) == pytest.approx(5, abs=5e-3)  # the feature is off by 1 of weight 5


def test_a_model_without_points_has_none_to_compare():
    with pytest.raises(RecipeError, match="sees no points to compare: take cost=latent"):
        KeypointDistance()(Known(PLACES), tiny.PLACE, GOAL)
    with pytest.raises(RecipeError, match=r"cost\.features is -1; it must be 0 or more"):
        KeypointDistance(features=-1)
