"""`acwm policy evaluate`, and other uses of a policy's file, with a policy that is best."""

import json

import av
import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.env.task import Goal
from acwm_core.errors import RecipeError
from acwm_core.evaluation.statistics import paired_bootstrap
from acwm_core.training.run import load_run
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.run import rank_policies
from acwm_planning.policies.saved import SavedPolicy
from acwm_policy.evaluate import solved_in_dream_alone
from tests import tiny
from tests.extras import needs
from tests.learning.world import straight


@pytest.fixture
def policy(parts, tmp_path):
    return straight(tmp_path / "policy")


def reachable(seed):
    """Whether twelve actions of two pixels lead to the goal, and how far it is."""
    env = tiny.task_environment()
    _, info = env.reset(options={"spec": tiny.spec(seed)})
    away = np.abs(env.goal.state["position"] - info["state"]["position"])
    return bool(np.linalg.norm(np.maximum(away - 24, 0)) <= tiny.PLACE.tolerance)


@needs("stable_baselines3")
def test_the_best_policy_solves_what_can_be_solved(run, policy, capsys):
    beside = ["--beside", str(policy)]
    with pytest.raises(SystemExit) as ended:
        main(["policy", "evaluate", str(policy), "--run", str(run), "--seeds", "0..7", *beside])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    found = json.loads((policy / "evaluation" / "evaluation.json").read_text())
    rows = {row["row"]: row for row in found["rows"]}
    assert [*rows] == ["trained", "dream", "beside", "solution", "behaviour", "random", "still"]
    assert rows["beside"]["successes"] == rows["trained"]["successes"]  # it is the same
    can = [seed for seed in range(8) if reachable(seed)]
    assert rows["trained"]["successes"] == rows["solution"]["successes"] == len(can)
    assert rows["still"]["successes"] == 0
    assert rows["trained"]["seeds"] == rows["still"]["seeds"] == [*range(8)]
    assert rows["trained"]["success"]["low"] < 1
    lines = (policy / "evaluation" / "episodes.jsonl").read_text().splitlines()
    won = {(each["row"], each["seed"]): each["success"] for each in map(json.loads, lines)}
    gaps = [won["dream", seed] - float(won["trained", seed]) for seed in range(8)]
    assert found["gap"]["mean"] == pytest.approx(paired_bootstrap(gaps).mean)
    assert "The same in the dream" in said
    assert f"{len(can)}/8" in said
    page = (policy / "evaluation" / "index.html").read_text()
    assert f"<dd>{len(can)}/8</dd>" in page
    assert page.count("<video") == 3


def test_episodes_that_only_the_dream_solves_are_named():
    won = {("trained", 1): True, ("dream", 1): True, ("trained", 4): False, ("dream", 4): True}
    won |= {("trained", 2): False, ("dream", 2): False, ("trained", 3): False, ("random", 3): True}
    won |= {("trained", 0): False, ("dream", 0): True}
    lines = [{"row": row, "seed": seed, "success": done} for (row, seed), done in won.items()]
    assert solved_in_dream_alone(lines) == [0, 4]


def test_a_video_has_the_dream_of_the_same_policy_beside_the_simulator(run, policy):
    """The model is exact, so its pictures and distances are those of the simulator."""
    from acwm_policy.evaluate import evaluate_policy

    evaluate_policy(policy, seeds=[2], run=run, rows=("trained", "dream"), videos=1, device="cpu")
    folder = policy / "evaluation" / "videos"
    curves = json.loads((folder / "trained-0002.json").read_text())
    assert curves["panels"] == ["simulator", "dream", "goal"]
    length = len(curves["distances"])
    assert length > 4
    np.testing.assert_allclose(curves["imagined"][:length], curves["distances"], atol=2.1)
    with av.open(str(folder / "trained-0002.mp4")) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(frames) == length
    side, width = frames[0].shape[:2]
    dream = (width - side) // 2  # the middle one of three panels
    for frame in frames:
        truth, dreamt = (
            np.argwhere(frame[:, left : left + side, 0] > 130).mean(0) for left in (0, dream)
        )
        assert np.abs(truth - dreamt).max() < side * 2 / 32  # of 32 px


@needs("stable_baselines3")
def test_the_dream_judges_as_the_task_does(run, policy):
    """The model is exact but for the half pixel that it reads, so both end alike, step by step."""
    from acwm_policy.evaluate import evaluate_policy

    evaluate_policy(policy, seeds=range(6), run=run, device="cpu")
    text = (policy / "evaluation" / "episodes.jsonl").read_text()
    lines = {(each["row"], each["seed"]): each for each in map(json.loads, text.splitlines())}
    for seed in range(6):
        dreamt, simulated = lines["dream", seed], lines["trained", seed]
        assert dreamt["start_distance"] == pytest.approx(simulated["start_distance"], abs=0.71)
        assert dreamt["distance"] == pytest.approx(simulated["distance"], abs=2.1)
        assert abs(dreamt["steps"] - simulated["steps"]) <= 1


def test_a_file_is_an_own_policy(run, policy, tmp_path):
    """In a ranking it acts on what the estimator reads, in the simulator and in the model."""
    ranking = rank_policies(
        run, "place", [str(policy)], seeds=range(3), out=tmp_path / "out", device="cpu"
    )
    (scores,) = ranking.policies
    assert scores.policy == str(policy)
    assert scores.loop == "closed"
    can = sum(map(reachable, range(3))) / 3
    assert scores.success["truth"] == pytest.approx(can)
    with pytest.raises(RecipeError, match=r"trained for slide\.place, not for slide\.shy"):
        rank_policies(run, "shy", [str(policy)], seeds=[0], out=tmp_path / "shy", device="cpu")


def test_what_is_unseen_is_taken_to_be_as_it_was(policy):
    card = tiny.Slide.card
    own = OwnPolicy(str(policy), card)
    own.reset(Goal({"position": np.array([20.0, 4.0])}, np.zeros(0), np.zeros(0)))
    assert own.act(np.zeros(0), {"position": np.array([4.0, 4.0])}).tolist() == [2, 0]
    hidden = own.act(np.zeros(0), {"position": np.array([np.nan, 0.0])})
    assert hidden.tolist() == [2, 1]
    saved = SavedPolicy.read(policy)
    saved.reset(Goal({"position": np.zeros(2)}, np.zeros(0), np.zeros(0)))
    with pytest.raises(RecipeError, match=r"observes position, which nothing here reads"):
        saved.predict({"velocity": np.zeros(2)})


def test_a_policy_of_another_world_is_refused(policy, run):
    card = load_run(run).card
    with pytest.raises(RecipeError, match=r"trained for slide\.place, not for unread\.place"):
        OwnPolicy(str(policy), tiny.Unread.card)
    assert OwnPolicy(str(policy), card).observes == "state"
