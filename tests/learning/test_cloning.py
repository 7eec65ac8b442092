"""`algorithm=clone`: what is learnt from recordings, with a task and without one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.task import Goal
from acwm_core.errors import DataError, RecipeError
from acwm_core.training.run import load_run
from acwm_formats.recordings import ImportOptions, import_dataset
from acwm_formats.timeline import RecordedDataset, Recording
from acwm_planning.futures import ModelRollouts
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.saved import PolicyInputs, SavedPolicy, small_pictures
from acwm_planning.prior import PolicyPrior
from acwm_policy.clone import Clone
from acwm_policy.evaluate import evaluate_policy
from acwm_policy.lesson import imitate
from acwm_policy.recordings import Recorded, Recordings
from acwm_policy.settings import PolicySettings, settings_of
from acwm_policy.train import train_policy
from tests import tiny

INPUTS = PolicyInputs({"position": [2]}, {"position": [2]}, [0.0] * 4, [1.0] * 4, [1.0] * 2)


@pytest.fixture(scope="module")
def data(parts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "data"
    generate("slide", folder, episodes={"train": 12}, workers=0, progress=False)
    return folder


def cloned(data, out, *words, name="slide.place", **options):
    settings = settings_of(["algorithm=clone", "net_arch=[32]", *words])
    options = {"steps": 12_800, "data": data, **options}
    return train_policy("slide", name, settings=settings, out=out, **options)


def recorded(frames=9):
    """An episode whose numbers tell their frames: at frame t it is at (t, 10 t)."""
    times = torch.arange(frames, dtype=torch.float64)
    states = torch.stack([times, 10 * times], 1)
    return Recorded(states, 100 + states, (times / 10)[:, None].expand(-1, 2))


def test_a_decision_is_what_was_done_next():
    """With two actions of three frames: their means; the goal is later than all of them."""
    recordings = Recordings([recorded()], [], INPUTS, hold=3, chunk=2)
    drawn = recordings.draw(200, torch.Generator().manual_seed(0))
    assert recordings.action_size == drawn.actions.shape[1] == 4
    frames = drawn.vectors[:, 0]
    assert {*frames.tolist()} == {0, 1, 2}
    np.testing.assert_allclose(drawn.actions[:, 0].numpy(), (frames.numpy() + 1) / 10, rtol=1e-6)
    np.testing.assert_allclose(drawn.actions[:, 2].numpy(), (frames.numpy() + 4) / 10, rtol=1e-6)
    np.testing.assert_allclose(
        drawn.vectors[:, 4].numpy(), frames.clamp(max=3).numpy()
    )  # moved in three frames
    limited = PolicyInputs(
        {"position": [2]}, {"position": [2]}, [0, 0, 100, 100], [1.0] * 4, [1.0] * 2
    )
    goals = Recordings([recorded()], [], limited, hold=3, chunk=2)
    later = goals.draw(200, torch.Generator().manual_seed(0)).vectors[:, 2]
    assert (later >= frames + 6).all()
    assert {*later.tolist()} == {6, 7, 8}


def test_error_is_measured_on_what_was_held_out():
    one, other = recorded(), recorded(12)._replace(actions=torch.zeros(12, 2, dtype=torch.float64))
    other.actions[6:] = 1.0
    recordings = Recordings([one], [other], INPUTS, hold=3)

    class Constant(torch.nn.Module):
        def __init__(self, value):
            super().__init__()
            self.value = value

        def forward(self, vectors):
            return torch.full((len(vectors), 2), self.value)

    mean = 0.4  # of nine actions from 0 to 0.8
    assert recordings.score(Constant(mean))["error"] == pytest.approx(1.0)
    half = (2 * 0.5**2 + 0.5**2) / (2 * mean**2 + (1 - mean) ** 2)  # of three decisions, one is 1
    assert recordings.score(Constant(0.5))["error"] == pytest.approx(half)
    alike = one._replace(actions=torch.ones(9, 2, dtype=torch.float64))
    with pytest.raises(DataError, match="all alike"):
        Recordings([alike], [], INPUTS, hold=3)
    with pytest.raises(DataError, match="more than the 30 frames of a decision"):
        Recordings([one], [other], INPUTS, hold=15, chunk=2)


def test_a_clone_is_a_policy_like_any_other(run, data, tmp_path):
    policy = cloned(data, tmp_path / "clone", "chunk=2")
    assert policy.card.chunk == 2
    assert policy.card.inputs.goal == {"position": [2]}
    found = evaluate_policy(tmp_path / "clone", seeds=range(2), run=run, device="cpu")
    assert {row["row"] for row in found["rows"]} >= {"trained", "dream", "random"}
    assert found["gap"] is not None


def test_a_chunk_is_taken_before_the_next_decision(data, tmp_path):
    cloned(data, tmp_path / "clone", "chunk=2", steps=256)
    saved = SavedPolicy.read(tmp_path / "clone")
    goal = Goal({"position": np.array([20.0, 4.0])}, np.zeros(0), np.zeros(0))
    places = [{"position": np.array(place)} for place in ([4.0, 4.0], [9.0, 9.0], [14.0, 3.0])]
    saved.reset(goal)
    first, second, third = (saved.predict(place) for place in places)
    saved.reset(goal)
    again = [saved.predict(places[0]), saved.predict(places[2])]
    assert np.array_equal([first, second], again)  # what is seen between changes nothing
    assert not np.array_equal(third, first)


def test_recordings_need_no_task(data, tmp_path):
    policy = cloned(data, tmp_path / "clone", name="slide")
    assert (policy.card.task, policy.card.inputs.goal) == ("", {})
    assert 0 < policy.card.training["error"] < 1.5
    own = OwnPolicy(str(tmp_path / "clone"), tiny.Slide.card)
    own.reset(Goal({}, np.zeros(0), np.zeros(0)))
    assert np.abs(own.act(np.zeros(0), {"position": np.array([4.0, 4.0])})).max() <= 2


def test_a_policy_without_a_task_acts_without_a_goal_and_is_judged_by_its_error(data, tmp_path):
    cloned(data, tmp_path / "clone", name="slide", steps=256)
    place = {"position": np.array([4.0, 4.0])}
    alone, reset = (SavedPolicy.read(tmp_path / "clone") for _ in range(2))
    reset.reset()
    assert np.array_equal(alone.predict(place), reset.predict(place))
    with pytest.raises(RecipeError, match=r"trained without a task.*curve\.csv"):
        evaluate_policy(tmp_path / "clone", seeds=range(1), device="cpu")
    cloned(data, tmp_path / "aimed", steps=256)
    with pytest.raises(RecipeError, match="needs its goal"):
        SavedPolicy.read(tmp_path / "aimed").reset()


@pytest.mark.parametrize("killed", [False, True])
def test_the_policy_of_the_lowest_error_is_kept(data, tmp_path, monkeypatch, killed):
    """Training that goes on after it overfits leaves the policy from before, also if killed."""
    errors = {256: 0.9, 512: 0.5, 768: 0.8, 1024: 0.7}
    monkeypatch.setattr(Recordings, "shortest", 256)
    monkeypatch.setattr(
        Recordings, "score", lambda self, network: {"error": errors[int(network[-1].steps)]}
    )
    learn = Clone.learn

    def learn_and_count(self, steps, report):
        learn(self, steps, report)
        self._network[-1].steps = self.steps

    monkeypatch.setattr(Clone, "learn", learn_and_count)
    for steps in (768, 1024) if killed else (1024,):
        policy = cloned(data, tmp_path / "clone", name="slide", steps=steps)
    assert (policy.card.training["steps"], policy.card.training["error"]) == (512, 0.5)
    brief = cloned(data, tmp_path / "brief", name="slide", steps=512)
    place = {"position": np.array([4.0, 4.0])}
    assert np.array_equal(policy.predict(place), brief.predict(place))


def test_what_cannot_be_imitated_is_one_sentence(data, tmp_path):
    with pytest.raises(RecipeError, match="imitates recordings: name a dataset with --data"):
        cloned(None, tmp_path / "a")
    with pytest.raises(RecipeError, match=r"clone learns from recordings, not in the dream"):
        cloned(data, tmp_path / "a", place="dream")
    with pytest.raises(RecipeError, match="is a task of reacher, not of slide"):
        cloned(data, tmp_path / "b", name="reacher.reach")
    with pytest.raises(RecipeError, match="holds recordings of slide: write slide in place of my_"):
        cloned(data, tmp_path / "b", name="my_robot")
    with pytest.raises(RecipeError, match="observe=spede: it was not recorded"):
        cloned(data, tmp_path / "c", "observe=[spede]")


def test_of_few_recordings_every_tenth_is_held_out(data):
    lesson = imitate(data, "slide", None, 4, 1)
    lengths = EpisodeDataset(data, "train").lengths
    assert len(lesson.recordings._learnt) == sum(lengths) - lengths[9] - 11 * 4
    assert len(lesson.recordings._tested.vectors) == -(-(lengths[9] - 4) // 4)


def picture_rows(frames):
    """Frames `[N, H, W, 3]` as rows of the same size."""
    whole = torch.from_numpy(np.array(frames)).permute(0, 3, 1, 2)
    return small_pictures(whole, whole.shape[2:])


def test_what_is_observed_of_pictures_is_now_the_change_and_the_goal():
    inputs = PolicyInputs({}, {}, [51.0] * 12, [102.0], [51.0], [2, 2], True)
    now, before, goals = (torch.full((1, 12), value, dtype=torch.uint8) for value in (255, 0, 153))
    seen = inputs.vectors(now, before, goals).unflatten(1, (inputs.channels, 2, 2))
    assert seen.shape[1] == 9
    np.testing.assert_allclose(seen[0, :, 0, 0], [2] * 3 + [5] * 3 + [1] * 3, rtol=1e-6)
    alone = replace(inputs, aims=False)
    assert alone.vectors(now, before, goals[:, :0]).shape == (1, alone.size) == (1, 24)


def test_pictures_shrink_by_areas():
    frame = np.zeros((1, 4, 6, 3), np.uint8)
    frame[0, :2, :2, 0] = 200
    frame[0, 0, 0, 0] = 100
    whole = torch.from_numpy(frame).permute(0, 3, 1, 2)
    found = small_pictures(whole, [2, 3]).reshape(3, 2, 3)
    assert found[0].tolist() == [[175, 0, 0], [0, 0, 0]]


@pytest.mark.ci
def test_a_clone_of_pictures_does_what_they_show(parts, tmp_path):
    """Actions of these recordings are constant, so the change of the picture tells them."""
    data = tmp_path / "data"
    generate("slide", data, episodes={"train": 60}, workers=0, progress=False)
    words = ["observe=pictures", "batch_size=64", "channels=[8,8]", "learning_rate=3e-3"]
    policy = cloned(data, tmp_path / "clone", *words, name="slide")
    assert policy.card.inputs.picture == [32, 32]
    assert policy.card.training["error"] < 0.6
    own = OwnPolicy(str(tmp_path / "clone"), tiny.Slide.card)
    assert own.observes == "frame"
    for number in range(3):
        episode = EpisodeDataset(data, "train")[number]
        own.reset(Goal({}, np.zeros(0), np.zeros(0)))
        own.act(episode.video[4], None)
        found = own.act(episode.video[8], None)
        now, before = (picture_rows(episode.video[[k]]) for k in (8, 4))
        with torch.no_grad():
            scaled = policy.scaled(policy.card.inputs.vectors(now, before, now[:, :0]))[0, 0]
        np.testing.assert_allclose(found, 2 * scaled.numpy(), atol=1e-5)


def test_a_clone_of_pictures_acts_in_the_simulator_at_a_task(run, data, tmp_path):
    policy = cloned(data, tmp_path / "clone", "observe=pictures", "channels=[4]", steps=512)
    assert policy.card.inputs.aims
    found = evaluate_policy(tmp_path / "clone", seeds=range(2), run=run, device="cpu")
    assert {row["row"] for row in found["rows"]} >= {"trained", "random"}
    assert found["gap"] is None
    rollouts = ModelRollouts(load_run(run).world_model, tiny.Slide.card, None)
    with pytest.raises(RecipeError, match="observes pictures, but a plan moves states"):
        PolicyPrior(str(tmp_path / "clone"), rollouts)


def test_recordings_without_states_are_cloned_from_their_pictures(data, tmp_path):
    recordings = [
        Recording(episode.video, episode.actions, {}) for episode in EpisodeDataset(data, "train")
    ]
    facts = {"kind": "arrays", "name": "slides"}
    bare = RecordedDataset("slide", recordings, facts, fps=10)
    options = ImportOptions(test_episodes=0)
    import_dataset(bare, tmp_path / "bare", options, workers=0, progress=False)
    policy = cloned(tmp_path / "bare", tmp_path / "clone", "picture=16", name="slide", steps=256)
    assert policy.card.inputs.picture == [16, 16]
    assert SavedPolicy.read(tmp_path / "clone").card.layers[0] == "picture 6 16 16"


def test_a_file_with_layers_that_fit_nothing_is_refused(data, tmp_path):
    cloned(data, tmp_path / "clone", "observe=pictures", "channels=[4]", steps=256)
    saved = SavedPolicy.read(tmp_path / "clone")
    for change in (
        {"layers": ["picture 9 32 31", *saved.card.layers[1:]]},
        {"layers": [saved.card.layers[0], "convolution 0", *saved.card.layers[2:]]},
        {"inputs": replace(saved.card.inputs, picture=[4000, 4000])},
        {"inputs": replace(saved.card.inputs, std=[])},
        {"chunk": 2},
    ):
        SavedPolicy(replace(saved.card, **change), saved._network).save(tmp_path)
        with pytest.raises(DataError, match="is no policy of this version"):
            SavedPolicy.read(tmp_path)


def test_a_dream_shows_no_pictures(run, tmp_path):
    settings = PolicySettings("backprop", ["pictures"])
    with pytest.raises(RecipeError, match="observe=pictures is for algorithm=clone"):
        train_policy(run, "slide.place", settings=settings, out=tmp_path / "out", steps=8, starts=2)
