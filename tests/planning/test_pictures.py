"""Plans to goal pictures, in a world that the model knows exactly and nothing simulates."""

import csv

import av
import numpy as np
import pytest
import torch
from PIL import Image

from acwm_core.data.generate import generate
from acwm_core.errors import RecipeError
from acwm_core.training.run import load_run
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.pictures import PicturePlanner, PictureTask
from acwm_planning.run import make_cost
from acwm_planning.settings import settings_of
from tests import tiny
from tests.planning.test_plan_command import acwm

FEW = ["planner.candidates=32", "planner.iterations=3", "planner.horizon=2", "cost.frames=1"]


@pytest.fixture(scope="module")
def sighted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sighted")
    tiny.register()
    generate("slide", folder / "data", episodes={"ind_test": 2}, workers=0, progress=False)
    return tiny.make_exact_run(folder / "run", "sighted", path=str(folder / "data"))


def picture(row, column):
    frame = tiny.squares(torch.tensor([[float(row), column]]))[0]
    return (frame.permute(1, 2, 0) * 255).round().byte().numpy()


def test_a_goal_costs_least_where_its_actions_lead(sighted):
    """Of several actions, those that lead to the picture cost least, and the others by distance."""
    bundle = load_run(sighted)
    moves = torch.tensor([[0.0, 0], [0, 1], [1, 0], [1, 1], [-1, -1]])
    actions = moves[:, None].expand(-1, 8, -1)
    goal = tiny.Goal({}, np.zeros((32, 32), np.uint8), picture(8 + 8, 8))  # eight steps of [1, 0]
    cost = make_cost(settings_of(["cost=points", "cost.frames=1"]))
    rollouts, history = ModelRollouts(bundle.world_model, bundle.card, None), picture(8, 8)
    judge = rollouts.cost(
        History(tiny.spec(0), [history]), np.zeros(2, np.float32), GoalCost(cost, None, goal), 0
    )
    wanted = (moves - moves[2]).norm(dim=1) * 8 / 16
    torch.testing.assert_close(judge(actions), wanted, atol=4e-3, rtol=0)


def test_a_plan_leads_to_the_picture(sighted):
    planner = PicturePlanner(load_run(sighted), settings_of([*FEW, "cost=points"]), "cpu")
    made = planner.plan([picture(8, 8)], [], picture(14, 5))
    place = np.array([8.0, 8.0]) + made.actions.sum(0)
    assert np.abs(place - [14, 5]).max() < 1.5
    assert made.cost < 0.2 * made.still_cost
    ends = tiny.corners_of(torch.from_numpy(made.imagined[-1:]).permute(0, 3, 1, 2).float())
    assert (ends - torch.tensor([14, 5])).abs().max() <= 1


def test_what_cannot_be_compared_is_refused(sighted):
    bundle = load_run(sighted)
    with pytest.raises(RecipeError, match="needs a task, and a goal picture has none"):
        PicturePlanner(bundle, settings_of(["cost=state"]), "cpu")
    planner = PicturePlanner(bundle, settings_of([*FEW, "cost=points"]), "cpu")
    with pytest.raises(RecipeError, match=r"pictures are uint8 \[32, 32, 3\]"):
        planner.plan([picture(8, 8)[:16]], [], picture(9, 9))
    with pytest.raises(RecipeError, match="needs a task"):
        PictureTask().distance(None, None)


def test_the_command_plans_from_a_recording_and_from_a_picture(sighted, tmp_path, capsys):
    Image.fromarray(picture(14, 5)).resize((64, 64), 0).save(goal := tmp_path / "goal.png")
    Image.fromarray(picture(8, 8)).save(start := tmp_path / "start.png")
    words = ["plan", sighted, *FEW, "--goal", goal, "--out", tmp_path / "plan"]
    code, out, err = acwm(capsys, *words, "--start", start)
    assert code == 0, err
    assert "cost=points" in out  # the model sees some, and nobody chose
    with (tmp_path / "plan/actions.csv").open() as file:
        names, *rows = csv.reader(file)
    assert names == ["dx", "dy"]
    place = np.array([8.0, 8.0]) + np.array(rows, float).sum(0)
    assert np.abs(place - [14, 5]).max() < 1.5
    with av.open(tmp_path / "plan/imagined.mp4") as video:
        assert sum(1 for _ in video.decode(video=0)) == len(rows)
    code, out, err = acwm(capsys, "plan", sighted, *FEW, "--episode", 1, "--out", tmp_path / "two")
    assert (code, "without motion" in out) == (0, True), err


def test_what_is_missing_is_said(sighted, capsys, tmp_path):
    for words, said in (
        ([], "give a TASK, or --goal PICTURE"),
        (["--goal", "x.png"], "from --start PICTURE or from --episode N: give one"),
        (["--goal", "x.png", "--start", "y.png"], "there is no y.png"),
        (["place", "--episode", "0"], "give the task place, or --goal and --episode"),
        (["place", "--start", "y.png"], "--start belongs to --goal"),
        (["--episode", "7"], "has no test episode 7: give 0 to 1"),
    ):
        code, _, err = acwm(capsys, "plan", sighted, *words)
        assert (code, said in err) == (2, True), err


def test_points_of_a_model_without_any_are_refused(tmp_path, capsys):
    run = tiny.make_exact_run(tmp_path / "run")
    code, _, err = acwm(capsys, "plan", run, "place", *FEW, "cost=points")
    assert code == 2
    assert err.splitlines()[-1].startswith("acwm: ")
    assert "sees no points to compare: take cost=latent" in err.splitlines()[-1]
