"""Policies of users: what they are shown, in the simulator and in a model, and what they may be."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from acwm_core.env.task import Goal
from acwm_core.errors import AcwmError
from acwm_core.training.run import load_run
from acwm_planning.policies.episode import true_outcome
from acwm_planning.policies.judges import EpisodeSimulator, ModelJudge
from acwm_planning.policies.own import OwnPolicy
from tests import tiny

MODULE = '''
import numpy as np
import torch

seen = []

def right(frame):
    """Once per latent frame, two pixels to the right."""
    seen.append(frame)
    return np.array([0.0, 2.0])

class Seeker:
    """Goes to the goal, which it is told, from where the estimator reads the square."""

    observes = "state"

    def reset(self, goal):
        self.goal = goal.state["position"]

    def predict(self, state):
        return np.clip((self.goal - state["position"]) / 4, -2, 2), None

class Bright(torch.nn.Module):
    def forward(self, picture):
        assert picture.shape == (1, 3, 32, 32) and 0 <= picture.min() and picture.max() <= 1
        return picture.mean((2, 3))[:, :2] * 2

network = Bright()
wild = lambda frame: np.array([99.0, -99.0])
short = lambda frame: np.zeros(3)
lost = lambda frame: np.array([np.nan, 0.0])
words = lambda frame: "left"
digits = lambda frame: ["1", "1"]
imaginary = lambda frame: np.array([1j, 0])
ragged = lambda frame: [1, [2, 3]]
number = 7

def breaks(frame):
    raise KeyError("no such thing")

def leaves(frame):
    raise SystemExit(0)

def presses(frame):
    raise KeyboardInterrupt

def paints(frame):
    frame[:] = 255
    return np.array([0.0, 2.0])

class Greedy:
    """Makes itself at home where it is told to go."""
    def reset(self, goal):
        goal.state["position"][:] = 0
        goal.frame[:] = 0
    def __call__(self, frame):
        return np.array([0.0, 2.0])

class Blind:
    observes = "sounds"
    def __call__(self, frame):
        return np.zeros(2)

class Unmade:
    def __init__(self):
        raise ValueError("no weights")
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    name = f"policies_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


@pytest.fixture(scope="module")
def stages(exact):
    bundle = load_run(exact)
    reader = tiny.SquareEstimator(bundle.card)
    simulator = EpisodeSimulator(tiny.task_environment(), 1, tiny.STRIDE, reader)
    return simulator, ModelJudge(bundle.world_model, reader, tiny.PLACE)


def own(module, name):
    return OwnPolicy(f"{module}:{name}", tiny.Slide.card)


def test_a_policy_decides_once_per_latent_frame_on_what_it_sees_there(module, stages):
    import importlib

    simulator, model = stages
    start = simulator.start(tiny.spec(2))
    policy = own(module, "right")
    seen = importlib.import_module(module).seen
    played = simulator.play_own(start, policy, 12)
    shown, seen[:] = list(seen), []
    wanted = [start.frames[-1], played.frames[3], played.frames[7]]
    assert len(shown) == 3
    assert all(map(np.array_equal, shown, wanted))
    assert np.array_equal(played.actions, np.tile([0, 2], (12, 1)))
    model.perform(start, policy, 12)
    assert len(seen) == 3
    columns = [frame[:, :, 0].max(0).argmax() for frame in seen]
    true = [frame[:, :, 0].max(0).argmax() for frame in shown]
    assert columns == pytest.approx(true, abs=1)  # it sees where the model has the square by then
    assert columns[2] > columns[0]
    seen.clear()


def test_states_and_goals_are_for_those_that_ask(module, stages):
    """It gets there in both, told where it is by the estimator."""
    simulator, model = stages
    for seed in range(3):
        start = simulator.start(tiny.spec(seed))
        policy = own(module, "Seeker")
        true = true_outcome(simulator.play_own(start, policy, 12), start)
        seen = model.perform(start, policy, 12)
        assert true.success == seen.success
        assert seen.returns == pytest.approx(true.returns, abs=20)
        assert true.distance < start.distance


def test_a_torch_module_sees_pictures_and_what_is_out_of_bounds_is_clipped(module):
    frame = np.zeros((32, 32, 3), np.uint8)
    frame[:, :, 0] = 255
    assert own(module, "network").act(frame, None).tolist() == [2, 0]
    assert own(module, "wild").act(frame, None).tolist() == [2, -2]
    assert isinstance(own(module, "Bright")._policy, torch.nn.Module)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("short", r"returned an array of shape \(3,\), but slide needs 2 finite numbers"),
        ("lost", "needs 2 finite numbers"),
        ("words", "needs 2 finite numbers"),
        ("digits", "needs 2 finite numbers"),
        ("imaginary", "needs 2 finite numbers"),
        ("ragged", "setting an array element"),
        ("breaks", r"when the policy \w+:breaks was called \(policies_\w+\.py:\d+\)$"),
        ("Blind", "observes 'sounds': frame or state"),
        ("Unmade", r"no weights\nwhen the policy \w+:Unmade was made"),
        ("number", "is not callable"),
        ("missing", "cannot be imported"),
    ],
)
def test_what_is_no_policy_is_told_in_a_sentence(module, name, message):
    with pytest.raises((AcwmError, ValueError, KeyError), match=message):
        own(module, name).act(np.zeros((32, 32, 3), np.uint8), None)


@pytest.mark.parametrize("name", ["paints", "Greedy"])
def test_what_a_policy_writes_in_changes_nothing(name, module, stages):
    """Neither the pictures that an estimator judges, nor the goal of those who come after it."""
    simulator, _ = stages
    start = simulator.start(tiny.spec(2))
    shown = [each.copy() for each in (start.frames, start.goal.frame, start.goal.state["position"])]
    usual = simulator.play_own(start, own(module, "right"), 12)
    played = simulator.play_own(start, own(module, name), 12)
    assert all(map(np.array_equal, played.frames, usual.frames))
    now = (start.frames, start.goal.frame, start.goal.state["position"])
    assert all(map(np.array_equal, now, shown))
    assert true_outcome(played, start) == true_outcome(usual, start)


def test_the_one_in_the_document_acts():
    text = (Path(__file__).parents[2] / "docs" / "policies.md").read_text()
    (block,) = [b for b in re.findall(r"```python\n(.*?)```", text, re.S) if "class Mine" in b]
    space = {}
    exec(block, space)
    policy = space["Mine"]()
    place = {"fingertip_position": np.array([0.5, -2.0])}
    policy.reset(Goal(place, np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3), np.uint8)))
    action = policy.predict({"fingertip_position": np.zeros(2)})
    assert (policy.observes, action.tolist()) == ("state", [1.5, -3])
