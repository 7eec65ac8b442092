"""`algorithm=clone`: what is learnt from recordings, with a task and without one."""

import numpy as np
import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.task import Goal
from acwm_core.errors import DataError, RecipeError
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.saved import PolicyInputs, SavedPolicy
from acwm_policy.evaluate import evaluate_policy
from acwm_policy.lesson import imitate
from acwm_policy.recordings import Recorded, Recordings
from acwm_policy.settings import settings_of
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


def test_what_cannot_be_imitated_is_one_sentence(data, tmp_path):
    with pytest.raises(RecipeError, match="imitates recordings: name a dataset with --data"):
        cloned(None, tmp_path / "a")
    with pytest.raises(RecipeError, match=r"clone learns from recordings, not in the dream"):
        cloned(data, tmp_path / "a", place="dream")
    with pytest.raises(RecipeError, match="is a task of reacher, not of slide"):
        cloned(data, tmp_path / "b", name="reacher.reach")
    with pytest.raises(RecipeError, match="observe=spede: it was not recorded"):
        cloned(data, tmp_path / "c", "observe=[spede]")


def test_of_few_recordings_every_tenth_is_held_out(data):
    lesson = imitate(data, "slide", None, 4, 1)
    lengths = EpisodeDataset(data, "train").lengths
    assert len(lesson.recordings._learnt) == sum(lengths) - lengths[9] - 11 * 4
    assert len(lesson.recordings._tested.vectors) == -(-(lengths[9] - 4) // 4)
