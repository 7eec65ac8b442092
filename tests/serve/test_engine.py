"""The engine against rollouts without a server, and joined streams against separate ones."""

import numpy as np
import pytest
import torch

from acwm_core.errors import AcwmError, RecipeError, ShapeError
from acwm_core.training.run import load_run
from acwm_serve import engine as engines
from acwm_serve.engine import Engine, Step
from tests import tiny

RUNS = ("exact", "carrying", "caching")


@pytest.fixture(params=RUNS)
def run(request):
    return request.getfixturevalue(request.param)


def picture(seed, size):
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)


def actions(number, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (number, 2)).astype(np.float32)


def begun(engine, seed, **options):
    message = {"frames": picture(seed, engine.card.frame_size), "seed": seed, **options}
    ((running, _),) = engine.start([engine.read_start(message)])
    return running


def stepped(engine, videos, rows):
    """The frames after one latent frame of each video."""
    steps = [
        Step(video, engine.read_actions({"actions": own}))
        for video, own in zip(videos, rows, strict=True)
    ]
    answers = engine.step(steps)
    for answer in answers:
        assert not isinstance(answer, AcwmError), answer
    return [answer["frames"] for answer in answers]


def rolled_out(run, frame, rows, seed):
    """What the model predicts without any of the server's parts, `[T, H, W, 3]` in 0 to 255."""
    world = load_run(run).world_model
    given = torch.from_numpy(frame).movedim(-1, -3)[None].float() / 255
    inputs = torch.from_numpy(np.concatenate([rows, rows[:1]]))[None]
    video = world.rollout(given, inputs, mode="stream", seeds=[seed])[0, 1:]
    return video.movedim(-3, -1).numpy() * 255


def test_every_video_is_that_of_a_rollout(run):
    """Also if several are predicted together and have begun together."""
    engine = Engine(run, device="cpu")
    assert engine.joins
    videos = [begun(engine, seed) for seed in range(3)]
    rows = [actions(5 * engine.stride, seed) for seed in range(3)]
    shown = [[], [], []]
    for start in range(0, 5 * engine.stride, engine.stride):
        parts = stepped(engine, videos, [each[start : start + engine.stride] for each in rows])
        for mine, part in zip(shown, parts, strict=True):
            mine.append(part)
    for seed, parts in enumerate(shown):
        wanted = rolled_out(run, picture(seed, engine.card.frame_size), rows[seed], seed)
        assert np.abs(np.concatenate(parts) - wanted).max() <= 0.501  # rounding to whole numbers


def test_clients_that_come_and_go_do_not_change_each_other_s_videos(run):
    """Different ages, different partners in every step, one that pauses."""
    engine = Engine(run, device="cpu")
    stride, ages = engine.stride, {0: 0, 1: 0, 2: 0}
    videos, shown = {}, {0: [], 1: [], 2: []}
    for together in ([0], [0, 1], [1], [0, 1, 2], [0, 2], [0, 1, 2], [1, 2]):
        for seed in together:
            videos.setdefault(seed, begun(engine, seed) if seed not in videos else None)
        rows = [
            actions(20 * stride, s)[ages[s] * stride : (ages[s] + 1) * stride] for s in together
        ]
        for seed, part in zip(
            together, stepped(engine, [videos[s] for s in together], rows), strict=True
        ):
            shown[seed].append(part)
            ages[seed] += 1
    for seed, parts in shown.items():
        rows = actions(20 * stride, seed)[: ages[seed] * stride]
        wanted = rolled_out(run, picture(seed, engine.card.frame_size), rows, seed)
        assert np.abs(np.concatenate(parts) - wanted).max() <= 0.501


def test_alike_videos_take_one_forward_pass(carrying, monkeypatch):
    engine = Engine(carrying, device="cpu")
    videos, passes = [begun(engine, seed) for seed in range(4)], []
    model = engine._world.model
    whole = type(model).next_state
    monkeypatch.setattr(
        type(model), "next_state", lambda *a: passes.append(len(a[2].modulation)) or whole(*a)
    )
    for _ in range(2):
        stepped(engine, videos, [actions(engine.stride)] * 4)
    assert passes == [4, 4]


def test_a_stream_that_cannot_be_joined_is_served_by_itself(carrying, monkeypatch):
    def refuse(*_):
        raise TypeError("no copies")

    monkeypatch.setattr(engines.Joiner, "joined", refuse)
    engine = Engine(carrying, device="cpu")
    assert not engine.joins
    videos = [begun(engine, seed) for seed in range(2)]
    rows = [actions(engine.stride, seed) for seed in range(2)]
    for seed, part in enumerate(stepped(engine, videos, rows)):
        wanted = rolled_out(carrying, picture(seed, engine.card.frame_size), rows[seed], seed)
        assert np.abs(part - wanted).max() <= 0.501


def test_joined_streams_that_mix_clips_are_noticed(carrying, monkeypatch):
    parted = engines.Joiner.parted
    monkeypatch.setattr(engines.Joiner, "parted", lambda *a: parted(*a)[::-1])
    assert not Engine(carrying, device="cpu").joins


def test_distances_are_those_of_the_world(exact):
    """The model knows its world, so its distances are the simulator's, up to the picture."""
    engine, world = Engine(exact, task="place", device="cpu"), tiny.task_environment()
    frame, info = world.reset(options={"spec": tiny.spec(1)})
    goal = info["goal"]
    message = {"frames": frame, "goal": goal.frame, "want": ["distance"]}
    ((video, first),) = engine.start([engine.read_start(message)])
    assert first["distance"] == pytest.approx([info["distance"]], abs=1.5)
    rows = actions(engine.stride, 3)
    (answer,) = engine.step([Step(video, engine.read_actions({"actions": rows}))])
    wanted = [world.step(row)[4]["distance"] for row in rows]
    assert answer["distance"] == pytest.approx(wanted, abs=1.5)
    assert answer["success"].shape == answer["distance"].shape


def test_a_component_s_error_reaches_its_clients_alone(carrying, monkeypatch):
    engine = Engine(carrying, device="cpu")
    old, new = begun(engine, 0), begun(engine, 1)
    stepped(engine, [old], [actions(engine.stride)])  # so both are computed apart
    whole = engine._step_alike

    def fail(steps):
        if steps[0].running is new:
            raise ValueError("out of paint")
        return whole(steps)

    monkeypatch.setattr(engine, "_step_alike", fail)
    steps = [Step(v, engine.read_actions({"actions": actions(engine.stride)})) for v in (old, new)]
    good, bad = engine.step(steps)
    assert good["frames"].shape[0] == engine.stride
    assert str(bad) == "ValueError: out of paint"


def test_keypoints_are_where_the_model_sees_things(data, tmp_path):
    run = tiny.make_exact_run(tmp_path / "run", model="sighted", path=str(data))
    engine, world = Engine(run, device="cpu"), tiny.task_environment()
    frame, _ = world.reset(options={"spec": tiny.spec(1)})
    ((video, _),) = engine.start([engine.read_start({"frames": frame, "want": ["keypoints"]})])
    rows = actions(engine.stride, 3)
    (answer,) = engine.step([Step(video, engine.read_actions({"actions": rows}))])
    for row in rows:
        _, _, _, _, info = world.step(row)
    place = info["state"]["position"][::-1]  # of the corner, right and down
    assert engine.facts()["keypoints"] == ["square", "nothing"]
    assert answer["keypoints"].shape == (2, 2)
    assert np.abs((answer["keypoints"][0] + 1) * 16 - tiny.SIDE / 2 - place).max() <= 1


@pytest.mark.ci
def test_states_are_those_that_the_model_predicts():
    """Of a trained model, for two clients together."""
    engine = Engine("reacher", device="cpu")
    low, high = (np.array(engine.facts()[name], np.float32) for name in ("low", "high"))
    rows = np.random.default_rng(0).uniform(low, high, (2, 3 * engine.stride, len(low)))
    rows = rows.astype(np.float32)
    videos = [begun(engine, seed, want=["states"]) for seed in range(2)]
    shown = []
    for part in np.split(rows, 3, 1):
        steps = [
            Step(v, engine.read_actions({"actions": own}))
            for v, own in zip(videos, part, strict=True)
        ]
        shown.append([answer["states"] for answer in engine.step(steps)])
    world = load_run("reacher").world_model
    for row in range(2):
        frame = torch.from_numpy(picture(row, engine.card.frame_size)).movedim(-1, 0)[None] / 255
        inputs = torch.from_numpy(np.concatenate([rows[row], rows[row, :1]]))[None]
        for name, values in world.predict_states(frame, inputs, seeds=[row]).items():
            own = np.concatenate([step[row][name] for step in shown])
            assert np.allclose(own, values[0].numpy(), atol=1e-4, equal_nan=True)


def test_plans_reach_the_goal(exact, monkeypatch):
    """The model knows its world, so acting by its plans alone solves the task."""
    few = ("planner.candidates=64", "planner.elites=8", "planner.iterations=3", "past=0")
    monkeypatch.setattr(tiny.ToPlace, "planning", few, raising=False)
    engine, world = Engine(exact, task="place", device="cpu"), tiny.task_environment()
    frame, info = world.reset(options={"spec": tiny.spec(1)})
    goal, frames, actions, planner = info["goal"].frame, [frame], [], engine.planner()
    while not info["success"] and len(actions) < 32:
        message = {"observed": np.stack(frames), "goal": goal}
        if actions:
            message["actions"] = np.stack(actions)
        (answer,) = engine.plan([engine.read_plan(message, planner)])
        for action in answer["actions"]:
            frame, *_, info = world.step(action)
            frames.append(frame)
            actions.append(action)
    assert info["success"]


def test_what_is_wrong_with_a_question_for_a_plan_is_said(exact, carrying):
    with pytest.raises(RecipeError, match="--task"):
        Engine(carrying, device="cpu").planner()
    engine = Engine(exact, task="place", device="cpu")
    planner, frames = engine.planner(), np.zeros((2, 32, 32, 3), np.uint8)
    between = np.zeros((1, 2), np.float32)
    whole = {"observed": frames, "actions": between, "goal": frames[0]}
    assert engine.read_plan(whole, planner).still.shape == (2,)
    for name, value in {
        "observed": frames[:, :8],
        "actions": between[:0],
        "goal": frames,
        "still": np.zeros(3),
        "seed": -1,
        "aim": 1,
    }.items():
        with pytest.raises((ShapeError, RecipeError), match=name):
            engine.read_plan({**whole, name: value}, planner)
