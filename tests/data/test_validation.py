"""What an environment makes is looked at before it becomes data; damaged statistics are found."""

import json
import re
import shutil

import numpy as np
import pytest
import yaml
from forging import problems
from square_world import Square

from acwm_core.data.card import MANIFEST
from acwm_core.data.generate import generate
from acwm_core.errors import AcwmError, DataError, PluginError
from acwm_core.plugins import catalog, hookimpl


def later(method, change):
    def changed(self):
        value = getattr(Square, method)(self)
        return change(value) if self._frame_index == 3 else value

    return changed


def with_nan(state):
    return {**state, "position": state["position"] * np.nan}


FLAWS = {
    "nan": ({"_state": later("_state", with_nan)}, "state position is not finite"),
    "infinite": (
        {"_state": later("_state", lambda s: {**s, "position": s["position"] + np.inf})},
        "state position is not finite",
    ),
    "strings": (
        {"_state": lambda self: {**Square._state(self), "position": np.array(["a", "b"])}},
        "state position is <U1",
    ),
    "shape": (
        {"_state": lambda self: {**Square._state(self), "position": np.zeros(3)}},
        r"state position is \(3,\)",
    ),
    "changing shape": (
        {"_state": later("_state", lambda s: {**s, "position": np.zeros(3)})},
        r"state position change their shape: \(2,\) and \(3,\)",
    ),
    "lost field": ({"_state": later("_state", lambda s: {})}, r"the state fields are \[\]"),
    "frames": (
        {"_render": lambda self: tuple(a[:16] for a in Square._render(self))},
        r"frames are \(16, 32, 3\), the card says 32×32",
    ),
    "one frame": (
        {"_render": later("_render", lambda r: (r[0][:8], r[1]))},
        r"frames change their shape: .*\(8, 32, 3\)",
    ),
    "float frames": (
        {"_render": lambda self: (Square._render(self)[0] / 255, Square._render(self)[1])},
        "video is float64",
    ),
    "masks": (
        {"_render": lambda self: (Square._render(self)[0], np.full((32, 32), 9, np.uint8))},
        "mask id 9 has no name",
    ),
    "contacts": (
        {"_contacts": lambda self: [(0, 7)]},
        "a contact refers to a frame or an instance",
    ),
}


class FlawedPlugin:
    """Every flaw as an environment of its own."""

    @staticmethod
    @hookimpl
    def register_environments(registry):
        for name, (methods, _) in FLAWS.items():
            known = name.replace(" ", "_")
            globals()[known] = type(known, (Square,), methods)
            registry.add(known, f"{__name__}:{known}", called=known)


@pytest.fixture(autouse=True, scope="module")
def flawed():
    catalog().add_plugin(FlawedPlugin, "flawed")


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_broken_episode_never_becomes_data(flaw, tmp_path):
    name, message = flaw.replace(" ", "_"), FLAWS[flaw][1]
    with pytest.raises(AcwmError, match=rf"{message}.*\nin episode 0 of train of {name}"):
        generate(name, tmp_path / "out", episodes={"train": 2}, workers=0, progress=False)
    assert not list((tmp_path / "out").rglob("*.tar"))


def test_a_card_has_the_name_that_is_registered(tmp_path):
    with pytest.raises(PluginError, match="'renamed_square' has a card with the name 'square'"):
        generate("renamed_square", tmp_path / "out", episodes={"train": 2}, progress=False)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def data(square_data, tmp_path):
    return shutil.copytree(square_data, tmp_path / "data")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "0.5", None, [1.0]])
@pytest.mark.parametrize("field", ["total", "squares", "low", "high"])
def test_sums_of_actions_that_are_no_numbers_are_found(field, value, data):
    path = data / "train" / MANIFEST
    first, *others = path.read_text().splitlines()
    record = json.loads(first)
    record["actions"][field][1] = value
    path.write_text("\n".join([json.dumps(record), *others, ""]))
    found = problems(data, replays=0)
    said = found[f"train/{MANIFEST}"]
    assert re.search(
        r"is damaged \(.*infinite or too large|is damaged \(.*a valid|not finite", said
    )


def test_sums_of_other_actions_are_found(data):
    path = data / "train" / MANIFEST
    first, *others = path.read_text().splitlines()
    record = json.loads(first)
    record["actions"]["total"][0] += 0.5
    path.write_text("\n".join([json.dumps(record), *others, ""]))
    found = problems(data, replays=0)
    assert "other sums of its actions" in found["train/shard-00000.tar"]
    assert "statistics are not those" in found[f"train/{MANIFEST}"]


@pytest.mark.parametrize("value", [float("nan"), "fast", None])
def test_statistics_of_actions_that_are_no_numbers_are_found(value, data):
    path = data / "card.yaml"
    card = yaml.safe_load(path.read_text())
    card["actions"]["train"]["mean"][0] = value
    path.write_text(yaml.safe_dump(card, sort_keys=False, allow_unicode=True))
    with pytest.raises(DataError, match=r"not finite|a valid number"):
        problems(data, replays=0)


def test_statistics_of_other_actions_are_found(data):
    path = data / "card.yaml"
    card = yaml.safe_load(path.read_text())
    card["actions"]["ood_test"]["std"][1] *= 2
    path.write_text(yaml.safe_dump(card, sort_keys=False, allow_unicode=True))
    assert "statistics are not those" in problems(data, replays=0)[f"ood_test/{MANIFEST}"]
