"""Factors, specs and the Environment base class, on a point that actions push about."""

import sys

import gymnasium
import numpy as np
import pytest

from acwm_core.env.environment import (
    ActionSpec,
    Environment,
    EnvironmentCard,
    StateField,
    resolve_size,
)
from acwm_core.env.episode import Episode, EpisodeSpec, Factor, draw_factors, ood_label
from acwm_core.env.task import Task
from acwm_core.errors import AcwmError, RecipeError, ShapeError
from acwm_core.evaluation.metric import MetricInfo

GAIN = Factor.continuous(
    "gain", "speed", train=(0.5, 1.0), ood=((1.5, 2.0), (0.1, 0.2)), nominal=0.75, active=True
)
COUNT = Factor.discrete("count", "points", train=(1, 2), ood=(3, 4), nominal=1, active=True)
SHADE = Factor.discrete("shade", "look", train=("light",), ood=("dark",), nominal="light")


class Point(Environment):
    card = EnvironmentCard(
        name="point",
        summary="A point that moves as told.",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-4.0, -4.0), (4.0, 4.0), "delta"),
        frame_size=(32, 48),
        fps=10,
        horizon=8,
        factors=(GAIN, COUNT, SHADE),
        ood_shifts=("gain", "count"),
        state=(StateField("position", (2,), "px", "from the top left"),),
        instances=("background", "point"),
        engine="numpy",
    )

    def _start(self, factors, rng):
        self.position = rng.uniform(8, 24, 2)

    def _advance(self, action):
        self.position = np.clip(self.position + action, 0, 31)

    def _render(self):
        mask = np.zeros(self.frame_size, np.uint8)
        x, y = self.position.astype(int)
        mask[y : y + 2, x : x + 2] = 1
        return np.repeat(mask[..., None] * np.uint8(255), 3, axis=2), mask

    def _state(self):
        return {"position": self.position.copy()}

    def _contacts(self):
        return [(1, 0)] if self.position[0] in (0, 31) else []

    def policy(self, rng):
        return lambda: rng.uniform(-4, 4, 2)


def test_vector_environments_hold_what_differs_between_their_members():
    vector = gymnasium.vector.SyncVectorEnv([Point, Point])
    vector.reset(seed=0)
    push = np.array([[-4, 0], [0, 0]], np.float32)
    *steps, last = (vector.step(push) for _ in range(Point.card.horizon - 1))
    assert [any(step[3]) for step in steps] == [False] * (Point.card.horizon - 2)
    assert all(last[3])  # truncated at the horizon
    assert last[-1]["contacts"].tolist() == [((0, 1),), ()]  # only the first reached the border
    assert last[-1]["state"]["position"].shape == (2, 2)


def test_an_action_of_an_unknown_kind_is_refused():
    """Else a dataset would be written that nobody can read."""
    with pytest.raises(ShapeError, match="absolute, delta, velocity, torque, not 'force'"):
        ActionSpec(("x",), ("N",), (-1.0,), (1.0,), "force")


@pytest.mark.parametrize(
    ("action", "sentence"),
    [([1.0], r"shape \(2,\)"), ([np.nan, 0], "not finite"), ([0, 5], "dy=5 .* out of its bounds")],
)
def test_bad_actions_are_refused(action, sentence):
    env = Point()
    with pytest.raises(AcwmError, match="call reset"):
        env.step(np.array([0.0, 0.0]))
    env.reset(seed=0)
    with pytest.raises(ShapeError, match=sentence):
        env.step(np.array(action))


def test_ood_test_shifts_each_factor_in_turn_and_labels_it():
    labels = []
    for index in range(10):
        values = draw_factors(EpisodeSpec("point", "ood_test", index), *POINT_FACTORS)
        labels.append(ood_label(Point.card.factors, values))
        assert values["shade"] == "light"
    assert labels[::2] == ["gain"] * 5
    assert {*labels[1::2]} == {"count=3", "count=4"}


POINT_FACTORS = (Point.card.factors, Point.card.ood_shifts)


@pytest.mark.parametrize("split", ["train", "ind_test"])
def test_in_distribution_splits_stay_inside_training_ranges(split):
    gains = []
    for index in range(200):
        values = draw_factors(EpisodeSpec("point", split, index), *POINT_FACTORS)
        assert ood_label(Point.card.factors, values) is None
        gains.append(values["gain"])
    assert min(gains) < 0.55
    assert max(gains) > 0.95


def test_a_setting_overrides_the_split_and_leaves_other_draws_alone():
    plain = draw_factors(EpisodeSpec("point", index=1), *POINT_FACTORS)
    swept = draw_factors(EpisodeSpec("point", index=1, factors={"gain": 1.7}), *POINT_FACTORS)
    assert swept == {**plain, "gain": 1.7}
    assert EpisodeSpec("point", index=1).rng("start").random() == pytest.approx(
        EpisodeSpec("point", index=1, factors={"gain": 1.7}).rng("start").random()
    )


@pytest.mark.parametrize(
    ("value", "severity"), [(0.7, 0), (1.0, 0), (2.0, 1.0), (1.5, 0.5), (3.0, 2.0), (0.1, 0.4)]
)
def test_severity_grades_linearly_outside_training(value, severity):
    assert GAIN.severity(value) == pytest.approx(severity)


def test_severity_of_counts_and_names():
    assert [COUNT.severity(n) for n in (1, 2, 3, 4)] == [0, 0, 0.5, 1]
    assert [SHADE.severity(s) for s in ("light", "dark")] == [0, 1]


@pytest.mark.parametrize(
    ("factors", "sentence"),
    [
        ({"gian": "ood"}, "no factor 'gian'; did you mean 'gain'"),
        ({"gain": "odd"}, "give train, ood, nominal or a number"),
        ({"count": 9}, "not possible"),
        ({"count": 2.5}, "not possible"),
    ],
)
def test_impossible_factor_words_are_refused(factors, sentence):
    with pytest.raises(RecipeError, match=sentence):
        Point().reset(options={"factors": factors})


def test_unknown_splits_are_refused():
    with pytest.raises(RecipeError, match="did you mean 'ind_test'"):
        EpisodeSpec("point", "int_test")  # type: ignore[arg-type]


def test_streams_and_episodes_draw_different_numbers():
    draws = {
        EpisodeSpec(env, split, index, seed).rng(stream).random()
        for env in ("a", "b")
        for split in ("train", "ood_test")
        for index in (0, 1)
        for seed in (0, 1)
        for stream in ("x", "y")
    }
    assert len(draws) == 32


@pytest.mark.parametrize(
    ("size", "expected"),
    [(None, (240, 400)), (48, (48, 80)), (64, (64, 104)), ((64, 128), (64, 128))],
)
def test_sizes_keep_the_aspect_ratio(size, expected):
    assert resolve_size(size, (240, 400)) == expected


@pytest.mark.parametrize("size", [63, 8, (64, 60)])
def test_impossible_sizes_are_refused(size):
    with pytest.raises(ShapeError, match="multiple of 8"):
        resolve_size(size, (240, 240))


def test_there_is_no_window_to_render_to():
    with pytest.raises(RecipeError, match="rendered as 'rgb_array'"):
        Point(render_mode="human")  # type: ignore[arg-type]


def test_an_episode_checks_its_lengths():
    video = np.zeros((3, 16, 16, 3), np.uint8)
    parts = {
        "spec": EpisodeSpec("point"),
        "video": video,
        "actions": np.zeros((3, 2), np.float32),
        "states": {"position": np.zeros((3, 2))},
        "masks": np.zeros((3, 16, 16), np.uint8),
        "contacts": np.zeros((0, 3), np.int32),
        "factors": {},
        "ood_label": None,
    }
    Episode(**parts)
    with pytest.raises(ShapeError, match="2 rows for 3 frames"):
        Episode(**{**parts, "actions": np.zeros((2, 2), np.float32)})
    with pytest.raises(ShapeError, match="must be zero"):
        Episode(**{**parts, "actions": np.ones((3, 2), np.float32)})


def test_the_unit_of_a_pure_number_is_not_shown():
    """SI calls it 1."""
    assert ActionSpec(("a", "b"), ("1", "m"), (0, 0), (1, 1), "delta").units == ("", "m")
    assert StateField("ratio", (), "1", "of it").unit == ""
    span = {"train": (0.0, 1.0), "ood": ((2.0, 3.0),), "nominal": 0.5}
    assert Factor.continuous("friction", "of it", **span, unit="1").unit == ""
    assert MetricInfo("1", True).unit == ""

    class Share(Task):
        unit = "1"

    assert Share.unit == ""


def said_by_a_fork():
    """What a process that is forked now says of an environment; empty if it works."""
    import multiprocessing

    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()

    def use():
        try:
            Point().reset(seed=0)
            there.send("")
        except AcwmError as error:
            there.send(str(error))

    process = context.Process(target=use)
    process.start()
    said = here.recv() if here.poll(60) else "it hangs"
    process.join(60)
    return said


@pytest.mark.parametrize("library", ["", "OpenGL", "glfw"])
def test_what_opengl_has_drawn_is_not_used_after_a_fork(monkeypatch, library):
    monkeypatch.setattr("acwm_core.env.environment._drawn_in", None)
    monkeypatch.setattr("acwm_core.env.environment._OPENGL", ("no_such_library", library))
    if library:
        monkeypatch.setitem(sys.modules, library, sys)
    assert said_by_a_fork() == ""  # nothing is drawn yet
    world = Point()
    world.reset(seed=0)
    assert ("'context': 'forkserver'" in said_by_a_fork()) == bool(library)
    world.reset(seed=1)  # here it goes on
