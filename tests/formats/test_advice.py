"""Which model suits recordings, by what moves in them: pictures that numpy draws."""

from dataclasses import replace

import numpy as np
import pytest

from acwm_core.cli.fit import _recipe_to_start
from acwm_core.data.card import DatasetCard
from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, StateField
from acwm_core.recipe import compose
from acwm_core.recipe.advice import advised
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.survey import advice
from acwm_formats.survey.movement import movement
from acwm_formats.survey.survey import survey
from tests import tiny

SIDE, FRAMES = 64, 24
GROUND = np.random.default_rng(0).integers(60, 200, (16, 16, 3)).astype(np.uint8)
WIDE = GROUND.repeat(16, 0).repeat(16, 1)  # [256, 256, 3]


def film(things=1, seed=0, drives=False, ground=None):
    """A video `[T, 3, 64, 64]` of white squares of 6 pixels that move over a patterned ground."""
    rng = np.random.default_rng(seed)
    places, moves = rng.uniform(4, 54, (things, 2)), rng.uniform(-1.5, 1.5, (things, 2))
    wide = WIDE if ground is None else ground
    frames = []
    for t in range(FRAMES):
        at = 20 + 3 * t * drives
        frame = wide[at : at + SIDE, at : at + SIDE].copy()
        for row, column in np.clip(places + t * moves, 0, SIDE - 6).astype(int):
            frame[row : row + 6, column : column + 6] = 255
        frames.append(frame)
    return np.moveaxis(np.stack(frames), -1, 1)


@pytest.fixture(scope="module")
def card():
    recorded = replace(tiny.Drift.card, state=(), camera=None)
    return DatasetCard(recorded, {"train": 200}, None, {}, {}, 1, {"format": "videos"})


def kind(card, *films):
    return advice.advice_on(card, movement(films))


def test_a_few_things_under_a_still_camera_are_for_points(card):
    found = kind(card, *(film(3, seed) for seed in range(4)))
    assert found.overlay == "points"
    assert "the camera stands still and what moves is about" in found.why


@pytest.mark.parametrize(
    ("films", "why"),
    [
        ([film(1, seed, drives=True) for seed in range(3)], "the camera moves"),
        ([film(16, seed) for seed in range(3)], "things move at once"),
        ([film(0)], "hardly anything moves"),
        ([film(2, s, ground=np.roll(WIDE, 48 * s, 1)) for s in range(4)], "the ground is another"),
        ([film(1)[:6]], "too short"),
    ],
)
def test_what_points_cannot_do_gets_the_usual_model(card, films, why):
    found = kind(card, *films)
    assert found.overlay == ""
    assert why in found.why


def test_few_recordings_and_declared_states(card):
    few = replace(card, splits={"train": 40})
    assert kind(few, film(2)).why == "there are 40 recordings, and points need 100 or more"
    state = StateField("cup", (2,), "m", "where the cup is")
    known = replace(card.environment, state=(state,), camera=Camera((0.0, -1.0, 1.0)))
    assert kind(replace(card, environment=known), film(2)).overlay == "scene"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("advice") / "mine"
    films = [np.moveaxis(film(2, seed), 1, -1) for seed in range(4)]
    actions = np.random.default_rng(0).uniform(-1, 1, (FRAMES, 2)).astype(np.float32)
    spec = ActionSpec(("dx", "dy"), ("m", "m"), (-1.0, -1.0), (1.0, 1.0), "delta")
    write_dataset(
        path, {"train": [Recording(f, actions) for f in films]}, name="mine", action=spec, fps=10
    )
    return path


def test_fit_small_takes_it_and_says_why(data, monkeypatch, capsys):
    monkeypatch.setattr(advice, "EPISODES", 4)
    words = ["small", f"data.path={data}"]
    recipe, run = _recipe_to_start(words, None, continues=False)
    assert recipe == compose("small", [*words[1:], "+points"])
    assert (recipe.model.params["points"], str(run)) == (16, "runs/small")
    said = capsys.readouterr().out
    assert said.startswith("small +points, because the camera stands still")
    assert said.count("\n") == 1
    texts = [each.text for each in survey(data).findings]
    assert any(text.startswith("acwm fit small takes +points") for text in texts)


def test_what_is_named_is_taken(data, monkeypatch):
    monkeypatch.setattr(advice, "EPISODES", 4)
    path = f"data.path={data}"
    assert advised("small", [path])[0] == ["+points", path]
    for word in ("+recurrent", "model=dit_xs", "objective=next_frame"):
        assert advised("small", [path, word]) == ([path, word], None)
    assert advised("small", [path, "model.layers=2"])[0][0] == "+points"
    assert advised("push_cube_small", [path])[1] is None  # it names no advisor


def test_only_recordings_are_looked_at(tmp_path):
    assert advised("small", [f"data.path={tmp_path}"])[1] is None
    tiny.register()
    made = tiny.make_dataset(tmp_path / "made", train=1, ind_test=0, ood_test=0)
    assert advised("small", [f"data.path={made}"])[1] is None
