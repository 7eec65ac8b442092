"""`acwm train-reward`: a reward that is known, learnt from columns, and what it is good for."""

import json
import re

import numpy as np
import pytest
import torch

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.task import Goal
from acwm_core.errors import DataError, RecipeError
from acwm_core.training.run import load_run
from acwm_dream.environment import Dream
from acwm_formats.recordings import ImportOptions, import_dataset
from acwm_formats.timeline import RecordedDataset, Recording
from acwm_planning.planner import Futures
from acwm_planning.predicted import observation_of
from acwm_planning.rewards.cost import RewardCost
from acwm_planning.rewards.head import RewardHead
from acwm_planning.rewards.task import RewardTask
from acwm_planning.rewards.training import train_reward
from acwm_planning.run import make_cost
from acwm_planning.settings import settings_of
from acwm_policy.evaluate import evaluate_policy
from acwm_policy.settings import PolicySettings
from acwm_policy.train import train_policy
from tests import tiny

MIDDLE = np.array([14.0, 10.0])
FRAMES, STEPS = 13, 300


def reward_at(places):
    return 5 - np.linalg.norm(places - MIDDLE, axis=-1)


def recorded(random, ahead, change=lambda rewards: rewards):
    """A square at places that follow each other, with its reward as a state and as a fact."""
    steps = random.uniform(-2, 2, (FRAMES, 2))
    places = np.clip(random.uniform(0, 24, 2) + np.cumsum(steps, 0), 0, 24)
    frames = (tiny.squares(torch.from_numpy(places)) * 255).byte().permute(0, 2, 3, 1).numpy()
    rewards = change(reward_at(places))
    after = [*rewards[1:], rewards[-1]]  # of the frame to which each action leads
    noise = random.normal(size=(FRAMES, 1))
    states = {"position": places, "unrelated": noise, "success": (rewards > 0)[:, None].astype(int)}
    facts = {"rewards": [*map(float, after)]}
    states |= {} if ahead else {"score": rewards[:, None]}
    return Recording(frames, steps, states, facts=facts)


def dataset(folder, episodes=40, **options):
    random = np.random.default_rng(3)
    made = [recorded(random, options.get("ahead", False)) for _ in range(episodes)]
    return written(folder, made)


def written(folder, episodes):
    facts = {"kind": "arrays", "name": "slides"}
    recordings = RecordedDataset("slide", episodes, facts, fps=10)
    bounds = ImportOptions(test_episodes=0)
    import_dataset(recordings, folder, bounds, workers=0, progress=False)
    return folder


@pytest.fixture(scope="module")
def data(parts, tmp_path_factory):
    return dataset(tmp_path_factory.mktemp("rewarded") / "data")


@pytest.fixture(scope="module")
def head(data, run, tmp_path_factory):
    out = tmp_path_factory.mktemp("rewards") / "head"
    train_reward(data, "score", out, run=run, steps=600)
    return out


@pytest.mark.parametrize("column", ["score", "rewards", "next.reward"])
def test_a_known_reward_is_learnt_from_a_state_or_a_fact(data, tmp_path, column):
    """At places that no episode has, and as a fact it is of the frame after each action."""
    found = train_reward(data, column, tmp_path / "head", states=["position"], steps=STEPS)
    places = np.random.default_rng(9).uniform(2, 22, (500, 2))
    error = found.of_states({"position": places}).numpy() - reward_at(places)
    assert np.var(error) / np.var(reward_at(places)) < 0.02
    held = found.card.held_out
    assert held.episodes == 5
    assert held.low <= held.share <= held.high < 0.05
    assert found.card.ahead == (column != "score")
    assert found.card.training["checksum"]


def test_the_error_is_that_of_episodes_that_were_not_seen(data, tmp_path):
    """What has nothing to do with the reward predicts it no better than its mean."""
    found = train_reward(data, "score", tmp_path / "head", states=["unrelated"], steps=300)
    assert found.card.held_out.share > 0.8


def test_how_an_episode_went_is_no_input(data, tmp_path):
    found = train_reward(data, "score", tmp_path / "head", steps=10)
    assert [field.name for field in found.card.state] == ["position", "unrelated"]


def test_a_success_is_reached_at_one_half(data, tmp_path):
    card = train_reward(data, "success", tmp_path / "head", states=["position"], steps=STEPS).card
    assert card.two_valued
    task = RewardTask(RewardHead.read(tmp_path / "head"), 12)
    seen = observation_of({"position": np.array([[14.0, 10.0], [14.0, 20.0]])}, 2)
    nothing = Goal({}, np.zeros((1, 1), np.uint8), np.zeros((1, 1, 3), np.uint8))
    assert task.success(seen, nothing).tolist() == [True, False]


class Places(Futures):
    """Two candidates, three frames, whose latents are the places `[2, 3, 2]`."""

    length, encoding = 3, ""

    def __init__(self, places, encoding=""):
        self.places, self.encoding = places, encoding

    def latents(self, frames):
        return torch.from_numpy(self.places[:, list(frames)]).float()[..., None, None]

    def predicted(self, frames):
        places = self.places[:, list(frames)].reshape(-1, 2)
        return observation_of({"position": places}, len(places))

    video = observe = still = None


def test_the_cost_is_what_is_lacking_in_deviations(head):
    card = RewardHead.read(head).card
    places = np.random.default_rng(1).uniform(2, 22, (2, 3, 2))
    found = RewardCost(head=str(head), frames=None)(Places(places), tiny.PLACE, None)
    lacking = np.maximum(card.best - reward_at(places), 0).mean(1) / card.std
    np.testing.assert_allclose(found.numpy(), lacking, atol=0.1)


def make_plan(run, capsys, out, *words):
    few = ["planner.candidates=48", "planner.iterations=4", "planner.elites=8", "--videos", "0"]
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(run), "place", *few, *words, "--seeds", "0,1", "--out", str(out)])
    said = capsys.readouterr()
    assert ended.value.code == 0, said.err
    lines = (out / "episodes.jsonl").read_text().splitlines()
    return said.out, [json.loads(line)["distance"] for line in lines]


@pytest.mark.ci
def test_a_plan_by_the_reward_goes_where_the_true_distance_leads(
    run, head, tmp_path, capsys, monkeypatch
):
    def sample_goal(self, environment, rng):
        environment._position = MIDDLE.copy()
        return Goal.now(environment)

    monkeypatch.setattr(tiny.ToPlace, "sample_goal", sample_goal)
    said, found = make_plan(run, capsys, tmp_path / "r", "cost=reward", f"cost.head={head}")
    _, wanted = make_plan(run, capsys, tmp_path / "s", "cost=state")
    assert np.mean(found) < np.mean(wanted) + 1.0
    error = RewardHead.read(head).card.held_out.text
    assert f"head_error: {error}" in said
    assert f"head_error={error}" in (tmp_path / "r" / "index.html").read_text()


@pytest.mark.ci
def test_a_policy_is_trained_by_the_reward_in_the_dream(run, head, tmp_path):
    """Without a task, it goes nearer to the best place than doing nothing, in the simulator too."""
    quick = {"net_arch": [32], "horizon": 3, "learning_rate": 1e-2, "noise": 0.2}
    settings = PolicySettings("backprop", parameters=quick)
    policy = train_policy(
        *(run, "slide"),
        settings=settings,
        out=tmp_path / "policy",
        steps=1920,
        scenes=16,
        starts=16,
        reward=head,
        device="cpu",
    )
    assert policy.card.task == ""
    assert policy.card.training["reward"]["held_out"]
    found = evaluate_policy(tmp_path / "policy", seeds=range(6), run=run, device="cpu")
    rows = {row["row"]: row["distance"]["value"] for row in found["rows"]}
    assert rows["trained"] < rows["random"] * 0.5
    assert rows["trained"] < rows["still"] * 0.5
    assert rows["dream"] == pytest.approx(rows["trained"], abs=1.0)


def test_a_reward_of_latents_judges_what_a_model_draws(data, run, tmp_path):
    """Its inputs are latents of the model's codec, of the last frame of each."""
    found = train_reward(data, "score", tmp_path / "head", run=run, latents=True, steps=50)
    world = load_run(run).world_model
    assert found.card.latents == world.codec.latents_fingerprint()
    assert found.card.held_out.share < 0.5
    places = torch.tensor([[14.0, 10.0], [22.0, 22.0]])
    with torch.no_grad():
        latents = world.encode(tiny.squares(places)[:, None].expand(-1, 5, -1, -1, -1))[:, -1]
    near, far = found.of_latents(latents).tolist()
    assert near > far + 5
    cost = RewardCost(head=str(tmp_path / "head"))
    with pytest.raises(RecipeError, match="latents of another codec"):
        cost(Places(np.zeros((2, 3, 2)), "other"), tiny.PLACE, None)
    with pytest.raises(RecipeError, match="only one of states can judge a scene"):
        RewardTask(found, 12)


def constant(rewards):
    return np.ones_like(rewards)


@pytest.mark.parametrize(
    ("change", "episodes", "column", "message"),
    [
        (None, 4, "scores", "keeps no column 'scores' .* did you mean 'score'"),
        (None, 4, "position", "keeps no column 'position' of one number"),
        (constant, 4, "score", "score is 1 in all frames to learn from"),
        (None, 2, "score", "has 2 episodes: 3 are needed, to hold some out"),
    ],
)
def test_what_cannot_be_learnt_is_one_sentence(tmp_path, capsys, change, episodes, column, message):
    random, changed = np.random.default_rng(0), {"change": change} if change else {}
    made = [recorded(random, False, **changed) for _ in range(episodes)]
    folder = written(tmp_path / "data", made)
    with pytest.raises(SystemExit) as ended:
        main(["train-reward", str(folder), "--from", column, "--out", str(tmp_path / "head")])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert re.search(message, said)
    assert said.count("\n") == 1
    assert not (tmp_path / "head").exists()


def test_a_reward_that_is_not_finite_is_refused(data, tmp_path, monkeypatch):
    read = EpisodeDataset.states

    def spoilt(self, index, names):
        values = read(self, index, names).copy()
        if [*names] == ["score"] and index == 2:
            values[4] = np.inf
        return values

    monkeypatch.setattr(EpisodeDataset, "states", spoilt)
    with pytest.raises(DataError, match=r"episode 2 of train .* has a score of inf in row 4"):
        train_reward(data, "score", tmp_path / "head", states=["position"])


def test_another_world_or_reward_is_refused(run, head, tmp_path):
    with pytest.raises(RecipeError, match="ENVIRONMENT and --reward"):
        train_policy(
            run, "slide.place", settings=PolicySettings(), out=tmp_path / "policy", reward=head
        )
    with pytest.raises(RecipeError, match="the reward is of slide, not of unread"):
        RewardTask.read(head, tiny.Unread.card)
    settings = settings_of(["cost=reward", f"cost.head={head}"])
    with pytest.raises(RecipeError, match="the reward is of slide, not of unread"):
        make_cost(settings, tiny.Unread.card)
    (head / "reward.safetensors").rename(tmp_path / "reward.safetensors")
    try:
        with pytest.raises(DataError, match="holds no reward head"):
            RewardHead.read(head)
        (head / "reward.safetensors").write_bytes(b"0" * 40)
        with pytest.raises(DataError, match="no reward head of this version"):
            RewardHead.read(head)
    finally:
        (tmp_path / "reward.safetensors").rename(head / "reward.safetensors")


def test_the_command_says_what_it_learnt(data, tmp_path, capsys):
    words = ["--from", "score", "--states", "position", "--steps", "20"]
    with pytest.raises(SystemExit) as ended:
        main(["train-reward", str(data), *words, "--out", str(tmp_path / "head")])
    said = capsys.readouterr().out
    assert ended.value.code == 0
    assert "from position" in said
    assert re.search(r"squared error: .* on 5 held-out episodes \(R² ", said)


@pytest.mark.parametrize("carried", [True, False], ids=["carried", "read"])
def test_a_dream_is_rewarded_by_what_was_learnt(run, head, tmp_path, carried):
    """Of the states that the model carries, or that an estimator reads: the known reward."""
    model = run if carried else tiny.make_exact_run(tmp_path / "run")
    env, best = Dream(run=model, reward=head, device="cpu"), RewardHead.read(head).card.best
    true, random, compared = tiny.Slide(), np.random.default_rng(0), 0
    for seed in range(4):
        env.reset(options={"spec": tiny.spec(seed)})
        true.reset(options={"spec": tiny.spec(seed)})
        over = late = False
        while not (over or late):
            action = random.uniform(-2, 2, 2).astype(np.float32)
            _, reward, over, late, info = env.step(action)
            places = [true.advance(action) or true.observe_state()["position"] for _ in range(4)]
            known = np.minimum(reward_at(np.stack(places)), best)
            if not over:  # else the step ends before its last frame
                assert reward == pytest.approx(known.sum(), abs=4.0)
                assert info["distance"] == pytest.approx(best - known[-1], abs=1.0)
                compared += 1
    assert compared > 3


def test_a_dream_takes_one_of_task_and_reward(run, head):
    with pytest.raises(RecipeError, match="task= or reward=, not both"):
        Dream(run=run, task="place", reward=head)
    with pytest.raises(DataError, match="holds no reward head"):
        Dream(run=run, reward=run)
