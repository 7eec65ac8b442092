"""Environments of Gymnasium as environments of acwm, and the package that `acwm new` writes."""

import importlib

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.checks import check_environment
from acwm_core.cli import main
from acwm_sim.gymnasium_world import resized
from tests.sim.gym_toys import Slider

TOYS = "tests.sim.gym_toys:tests"


@pytest.fixture
def written(tmp_path, monkeypatch):
    """``written(name, env_id)``: the class in the package that the command writes."""

    def write(name, env_id):
        folder = tmp_path / name
        words = ["new", "environment", name, "--from-gym", env_id, "--out", str(folder)]
        told = CliRunner().invoke(main, words)
        assert told.exit_code == 0, told.output
        path = folder / f"acwm_{name}" / f"{name}.py"
        assert len(path.read_text().splitlines()) < 60
        monkeypatch.syspath_prepend(str(folder))
        module = importlib.import_module(f"acwm_{name}.{name}")
        return getattr(module, "".join(word.capitalize() for word in name.split("_")))

    return write


def test_the_package_that_is_written_conforms(written):
    world = written("slid_bar", f"{TOYS}/Slider-v0")
    assert [str(r) for r in check_environment(world) if not r.passed] == []


def test_frames_states_and_actions_are_those_of_the_environment(written):
    env, true = written("moved_bar", f"{TOYS}/Slider-v0")(), Slider()
    assert [field.name for field in env.card.state] == ["place"]
    _, info = env.reset(seed=3)
    true.place = info["state"]["place"][0]
    for _ in range(12):  # also beyond the place where the environment ends
        frame, _, _, _, info = env.step(np.ones(1, np.float32))
        true.step(np.ones(1))
        assert info["state"]["place"] == pytest.approx([true.place])
        assert np.array_equal(frame, true.render()[:, 16:80])
    assert true.place > 40


def test_choices_become_one_hot(written):
    env = written("chosen_bar", f"{TOYS}/Chooser-v0")()
    assert env.card.action.size == 3
    _, before = env.reset(seed=0)
    _, _, _, _, after = env.step(np.array([0, 0, 1], np.float32))
    assert after["state"]["place"] - before["state"]["place"] == pytest.approx([3])
    draws = [env.policy(np.random.default_rng(k))() for k in range(20)]
    assert {tuple(each) for each in draws} == {tuple(row) for row in np.eye(3)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["environment", "bar", "--from-gym", f"{TOYS}/Missing-v0"], "cannot be made"),
        (["environment", "bar", "--from-gym", "no_module:X-v0"], "cannot be made"),
        (["environment", "bar", "--from-gym", f"{TOYS}/Free-v0"], "only a bounded Box or Discrete"),
        (["codec", "bar", "--from-gym", f"{TOYS}/Slider-v0"], "only an environment"),
    ],
)
def test_what_cannot_be_wrapped_is_refused(tmp_path, words, said):
    told = CliRunner().invoke(main, ["new", *words, "--out", str(tmp_path / "made")])
    assert told.exit_code == 2
    assert said in told.output
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("size", [(64, 64), (32, 48), (64, 32)])
def test_pictures_keep_their_proportions(size):
    picture = np.zeros((400, 600, 3), np.uint8)
    rows, columns = np.indices((400, 600)) - np.array([200, 300])[:, None, None]
    picture[np.hypot(rows, columns) < 60] = 255
    lit = resized(picture, size)[..., 0] > 127
    assert lit.shape == size
    assert abs(int(lit.any(0).sum()) - int(lit.any(1).sum())) <= 1  # still round
