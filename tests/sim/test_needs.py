"""PyBullet is an extra of its own: without it, two worlds say what to do, and all else works."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from acwm_sim.needs import BULLET, PIN

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


def without_pybullet(code):
    """What a process prints in which PyBullet is not installed."""
    missing = "import sys; sys.modules.update(pybullet=None, pybullet_data=None)\n"
    words = [sys.executable, "-c", missing + code]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_the_advice_fits_the_extra():
    line, _ = PROJECT["optional-dependencies"][BULLET["extra"]]
    requirement = Requirement(line)
    assert f"{requirement.name}{requirement.specifier}" == PIN
    assert requirement.marker
    assert requirement.marker.evaluate() is (BULLET["install"] == "")


def test_two_worlds_say_what_to_do():
    code = """
from acwm_core.plugins import catalog
from acwm_core.errors import MissingExtraError
for component in catalog().registry("environment"):
    try:
        component.load()
    except MissingExtraError as error:
        print(component.name, "pybullet" in component.needs, error)
"""
    lines = without_pybullet(code).splitlines()
    assert [line.split()[:2] for line in lines] == [["robot_arm", "True"], ["stack_cube", "True"]]
    assert all("acwm[bullet]" in line for line in lines)


@pytest.mark.ci
def test_their_models_predict():
    code = """
import acwm, torch
for name in ("robot_arm", "stack_cube"):
    _, card, model = acwm.load(name)
    with torch.no_grad():
        actions = torch.zeros(1, 5, card.action.size)
        video = model.rollout(torch.zeros(1, 3, 64, 64), actions)
    print(name, *video.shape)
"""
    assert without_pybullet(code) == "robot_arm 1 5 3 64 64\nstack_cube 1 5 3 64 64\n"
