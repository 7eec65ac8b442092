"""What a model imagines of candidates, against the same model's own rollouts."""

import math

import numpy as np
import pytest
import torch

from acwm_core.errors import DataError, RecipeError
from acwm_core.model.state_stream import StateStream
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_planning.futures import GoalCost, History, ModelFutures, ModelRollouts
from acwm_planning.planner import Cost
from acwm_planning.run import make_cost
from acwm_planning.settings import settings_of
from tests import tiny
from tests.learning.test_scenes import arms
from tests.plugins import plugin_of

STILL = np.zeros(2, np.float32)


def candidates(number, length, seed=0):
    return 4 * torch.rand(number, length, 2, generator=torch.Generator().manual_seed(seed)) - 2


@pytest.fixture(scope="module")
def bundle(run):
    return load_run(run)


@pytest.fixture
def history(bundle):
    """Four actions of an episode."""
    environment = tiny.Slide()
    frame, _ = environment.reset(options={"spec": tiny.spec(0)})
    found = History(tiny.spec(0), [frame])
    for action in candidates(1, 4, seed=9)[0].numpy():
        found.frames.append(environment.step(action)[0])
        found.actions.append(action)
    return found


def seen(rollouts, history, actions, seed=0):
    """The futures that a cost is handed."""
    found = []

    def judge(futures, task, goal):
        found.append(futures)
        return torch.zeros(len(futures.latents([0])))

    rollouts.cost(history, STILL, GoalCost(judge, None, None), seed)(actions)
    return found


def frame_of(picture):
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


def test_futures_are_the_rollout_of_the_model(bundle, history):
    """Whole, from the last frame, with the seed that all candidates share."""
    actions = candidates(3, 6)
    (futures,) = seen(ModelRollouts(bundle.world_model, bundle.card, None), history, actions, 5)
    assert futures.length == 3
    rows = torch.nn.functional.pad(actions, (0, 0, 0, 1))
    given = frame_of(history.frames[-1]).expand(3, -1, -1, -1)
    video = bundle.world_model.rollout(given, rows, mode="whole", seeds=[5] * 3)
    torch.testing.assert_close(futures.video([0, 1, 2]), video[:, [2, 4, 6]])
    torch.testing.assert_close(futures.video([2]), video[:, [6]])


def test_futures_are_decoded_with_the_current_frame_as_reference(bundle, history, monkeypatch):
    """Those that a cost sees, and those that are shown."""
    codec, references = bundle.world_model.codec, []
    monkeypatch.setattr(codec, "with_reference", lambda frame: references.append(frame) or codec)
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None)
    seen(rollouts, history, candidates(2, 4))
    rollouts.imagine(history, STILL, candidates(1, 4)[0], 0)
    assert len(references) == 2
    for frame in references:
        torch.testing.assert_close(frame, frame_of(history.frames[-1]))


def test_a_plan_that_ends_within_a_latent_frame_is_judged_where_it_ends(bundle, history):
    actions = candidates(2, 5)
    (futures,) = seen(ModelRollouts(bundle.world_model, bundle.card, None), history, actions)
    rows = torch.nn.functional.pad(actions, (0, 0, 0, 1))
    given = frame_of(history.frames[-1]).expand(2, -1, -1, -1)
    video = bundle.world_model.rollout(given, rows, mode="whole", seeds=[0, 0])
    torch.testing.assert_close(futures.video([1, 2]), video[:, [4, 5]])


def test_the_past_is_what_was_done(bundle, history):
    """From two latent frames back, under the actions taken since."""
    actions = candidates(2, 4)
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None, past=2)
    (futures,) = seen(rollouts, history, actions)
    taken = torch.from_numpy(np.stack(history.actions))[None].expand(2, -1, -1)
    rows = torch.nn.functional.pad(torch.cat([taken, actions], 1), (0, 0, 0, 1))
    given = frame_of(history.frames[0]).expand(2, -1, -1, -1)
    video = bundle.world_model.rollout(given, rows, mode="whole", seeds=[0, 0])
    torch.testing.assert_close(futures.video([0, 1]), video[:, [6, 8]])
    clip = rollouts.imagine(history, STILL, actions[0], 0)
    torch.testing.assert_close(clip, video[0, 5:9])


def test_before_the_start_everything_stood_still(bundle, history):
    world = bundle.world_model
    start = History(history.spec, history.frames[:1])
    rollouts = ModelRollouts(world, bundle.card, None, past=3)
    still = np.array([0.5, -0.5], np.float32)
    world.context_frames = 3
    try:
        given = rollouts._given(start, still)
    finally:
        world.context_frames = 1
    assert torch.equal(given.actions, torch.tensor([[[0.5, -0.5]] * 2]))
    frames = frame_of(history.frames[0])[None].expand(-1, 3, -1, -1, -1)
    torch.testing.assert_close(given.latents, world.encode(frames))


def test_candidates_differ_by_their_actions_alone(bundle, history):
    """The same actions lead to the same future, in whatever batch."""
    actions = candidates(5, 4)
    actions[3] = actions[1]
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None)
    (futures,) = seen(rollouts, history, actions)
    latents = futures.latents([0, 1])
    assert torch.equal(latents[3], latents[1])
    assert not torch.equal(latents[2], latents[1])
    parts = seen(ModelRollouts(bundle.world_model, bundle.card, None, batch=2), history, actions)
    assert [len(part.latents([0])) for part in parts] == [2, 2, 1]
    torch.testing.assert_close(torch.cat([part.latents([0, 1]) for part in parts]), latents)


@pytest.mark.parametrize("objective", ["full_sequence", "diffusion_forcing", "next_frame"])
def test_the_gradient_of_a_sampled_future_is_its_slope(tmp_path, history, objective):
    """Through all sampling steps and, with `next_frame`, through the frames before."""
    model = {"name": "dit_xs", "width": 16, "layers": 2}
    objective = {"name": objective, "prediction": "clean", "steps": 3}
    parts = {"model": model, "conditioner": {"name": "adaln"}, "objective": objective}
    bundle = load_run(tiny.make_slide_run(tmp_path, parts=parts))
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None)

    def judge(futures, task, goal):
        return futures.latents([0, 1]).square().flatten(1).sum(1)

    cost = rollouts.cost(history, STILL, GoalCost(judge, None, None), 3)
    actions = candidates(2, 4)
    wanted = actions.clone().requires_grad_()
    cost(wanted).sum().backward()
    steepness = wanted.grad.flatten(1).norm(dim=1)
    move = wanted.grad / steepness[:, None, None]
    slope = (cost(actions + 0.01 * move) - cost(actions - 0.01 * move)) / 0.02
    assert steepness.min() > 0.05
    torch.testing.assert_close(steepness, slope, rtol=0.03, atol=1e-3)


def test_a_prediction_that_is_not_finite_costs_nan_whatever_the_cost_says(bundle, history):
    rollouts = ModelRollouts(bundle.world_model, bundle.card, None)
    predict = bundle.world_model.objective.predict

    def broken(*args, **options):
        latents = predict(*args, **options).clone()
        latents[1, -1, 0, 0, 0] = math.inf
        return latents

    bundle.world_model.objective.predict = broken
    try:
        free = GoalCost(lambda futures, task, goal: torch.zeros(3), None, None)
        cost = rollouts.cost(history, STILL, free, 0)
        found = cost(candidates(3, 4))
    finally:
        del bundle.world_model.objective.predict
    assert found.isnan().tolist() == [False, True, False]


@pytest.mark.parametrize(("fast", "tolerance"), [(False, 1e-5), (True, 0.01)])
def test_a_memoryless_codec_decodes_no_more_than_is_asked_for(monkeypatch, fast, tolerance):
    """The pictures are those of the whole video, in bfloat16 too."""
    from acwm_core.plugins import catalog

    monkeypatch.setattr("acwm_planning.futures.bfloat16_is_fast", lambda: fast)

    codec = catalog().create("codec", "compact")
    assert codec.memoryless
    latents = torch.randn(2, 4, codec.channels, 4, 4, generator=torch.Generator().manual_seed(0))
    video = codec.decode(latents)
    futures = ModelFutures(
        codec, latents[:, :1], 0, 3, lambda frames: latents[:, 1:][:, list(frames)], 1, None, []
    )
    with torch.no_grad():
        made = futures.video([0, 2])
    assert made.dtype == torch.float32
    torch.testing.assert_close(made, video[:, [4, 10]], atol=tolerance, rtol=0)


def test_a_frame_is_predicted_once(bundle, history):
    """Whatever a cost asks for, and in which order."""
    asked, latents = [], torch.randn(2, 4, 16, 4, 4)

    def predict(frames):
        asked.append(list(frames))
        return latents[:, 1:][:, list(frames)]

    codec = bundle.world_model.codec
    futures = ModelFutures(codec, latents[:, :1], 0, 3, predict, 1, None, [])
    assert futures.latents([2]).equal(latents[:, 3:])
    assert futures.latents([0, 2]).equal(latents[:, [1, 3]])
    assert futures.finite.all()
    assert asked == [[2], [0]]


@pytest.mark.parametrize("past", [0, 1])
def test_predicted_states_are_those_of_the_last_planned_frames(bundle, history, past, monkeypatch):
    """Of a model that counts video frames from the given one on, and of plans of five actions."""
    world, stride = bundle.world_model, bundle.world_model.codec.temporal_stride

    def count(given, conditioning, frames, generators):
        assert len(given) == 1
        number = stride * (frames - given.shape[1])
        return torch.arange(1.0, 1 + number)[:, None].expand(3, -1, 2)

    monkeypatch.setattr(world, "state_shapes", {"pair": (2,)})
    monkeypatch.setattr(type(world), "predicts_states", True)
    monkeypatch.setattr(world.model, "predict_states", count, raising=False)
    rollouts = ModelRollouts(world, bundle.card, None, past=past)
    (futures,) = seen(rollouts, history, candidates(3, 5))
    now = past * stride
    wanted = [now + stride, now + 5]
    pair = futures.predicted([0, futures.length - 1]).states["pair"]
    np.testing.assert_array_equal(pair.reshape(3, 2, 2)[1], [[each] * 2 for each in wanted])


@pytest.mark.parametrize("diverged", [[], [1], [0, 1, 2]])
def test_states_that_are_not_finite_are_no_prediction(bundle, diverged):
    """But for those that the model never knows."""
    states = torch.zeros(3, 4, 2)
    states[..., 1] = torch.nan
    states[diverged, 2:] = torch.nan
    given = torch.zeros(3, 1, 16, 4, 4)
    codec = bundle.world_model.codec
    if len(diverged) == 3:
        states[:] = torch.nan
    fields = {"known": states[..., :1], "unknown": states[..., 1:]}
    futures = ModelFutures(codec, given, 0, 2, None, 1, None, [], lambda name: fields, fields)
    assert futures.predicted([0]).states["known"].shape == (3, 1)
    assert futures.finite.tolist() == [clip not in diverged for clip in range(3)]


def test_only_a_model_that_carries_states_starts_as_far_back_as_these_may(history, bundle):
    """And only for a cost that takes them."""
    for words, world, taken in (
        (["cost=state", "state_past=2"], arms(2), 4),
        (["cost=state", "state_past=2"], bundle.world_model, 2),
        (["cost=state", "cost.read=pictures", "state_past=2"], arms(2), 2),
        (["cost=latent", "state_past=2"], arms(2), 2),
        (["cost=state"], arms(2), 2),
    ):
        settings = settings_of(["past=1", *words])
        rollouts = settings.rollouts(make_cost(settings))
        given = ModelRollouts(world, bundle.card, None, **rollouts)._given(history, STILL)
        assert given.actions.shape[1] == taken


class Mine(Cost):
    """A cost of a plugin, whose needs a test declares."""

    def __call__(self, futures, task, goal):
        raise NotImplementedError


def test_an_own_cost_says_itself_what_it_asks_of_futures(monkeypatch):
    """Settings of planning know no cost by its name."""
    if "own_cost" not in catalog().plugins:
        catalog().add_plugin(plugin_of(costs={"mine": f"{__name__}:Mine"}), "own_cost")
    settings = settings_of(["cost=mine", "past=1", "state_past=2"])
    for carried, observes, past, rows in ((True, False, 2, []), (False, True, None, ["codec"])):
        monkeypatch.setattr(Mine, "carried", carried)
        monkeypatch.setattr(Mine, "observes", observes)
        assert settings.rollouts(make_cost(settings))["state_past"] == past
        assert settings.rows(["codec"]) == rows


@pytest.mark.parametrize("past", [0, 1, 2])
def test_states_of_candidates_are_those_that_the_model_predicts(history, bundle, past, monkeypatch):
    """The past is predicted once for all of them, and a field when a cost asks for it."""
    world, advanced = arms(2), []
    history.actions[:] = [action / 4 for action in history.actions]
    rollouts, actions = ModelRollouts(world, bundle.card, None, past=past), candidates(3, 5) / 4
    taken = (
        torch.from_numpy(np.stack(history.actions))[-2 * past :][None] if past else actions[:, :0]
    )
    rows = torch.cat([taken.expand(3, -1, -1), actions, actions[:, -1:]], 1)
    rows = torch.nn.functional.pad(rows, (0, 0, 0, 1))
    given = frame_of(history.frames[-1 - 2 * past]).expand(3, -1, -1, -1)
    whole = world.predict_states(given, rows)["all"][:, 2 * past :]
    step = StateStream.step
    monkeypatch.setattr(
        StateStream, "step", lambda self, rows: advanced.append(len(rows)) or step(self, rows)
    )

    def judge(futures, task, goal):
        seen = futures.predicted([0, 2])
        before = len(advanced)
        torch.testing.assert_close(
            torch.from_numpy(seen.states["all"]),
            whole[:, [1, 4]].flatten(0, 1),
            rtol=1e-4,
            atol=1e-4,
        )
        np.asarray(futures.predicted([1]).states["all"])
        assert len(advanced) - before == past * (not before) + 3
        return torch.zeros(3)

    cost = rollouts.cost(history, STILL, GoalCost(judge, None, None), 0)
    assert cost(actions).equal(cost(actions))
    assert advanced == [1] * past + [3] * 6


def test_longer_plans_than_the_model_knows_are_refused(bundle, history):
    with pytest.raises(RecipeError, match="trained on clips of 9 frames"):
        seen(ModelRollouts(bundle.world_model, bundle.card, None), history, candidates(1, 10))


def test_states_need_an_estimator(bundle, history):
    (futures,) = seen(
        ModelRollouts(bundle.world_model, bundle.card, None), history, candidates(1, 4)
    )
    with pytest.raises(DataError, match="no estimator reads the states"):
        futures.observe([0])


def test_the_goal_is_encoded_once_for_a_decision(bundle, history, monkeypatch):
    from acwm_planning import futures

    encoded, still_latent = [], futures.still_latent
    monkeypatch.setattr(
        futures, "still_latent", lambda *given: encoded.append(1) or still_latent(*given)
    )
    goal = history.frames[2]
    stills = []

    def judge(each, task, _):
        stills.append(each.still(goal))
        return torch.zeros(len(each.latents([0])))

    rollouts = ModelRollouts(bundle.world_model, bundle.card, None, batch=2)
    cost = rollouts.cost(history, STILL, GoalCost(judge, None, None), 0)
    cost(candidates(5, 4))
    cost(candidates(2, 4))
    assert (len(stills), len(encoded)) == (4, 1)
    still = frame_of(goal)[:, None].expand(-1, 3, -1, -1, -1)
    torch.testing.assert_close(stills[-1], bundle.world_model.encode(still)[:, -1:])


def test_pictures_made_on_the_fly_are_not_taken_for_each_other(bundle, history):
    (futures,) = seen(
        ModelRollouts(bundle.world_model, bundle.card, None), history, candidates(1, 4)
    )
    for shade in range(0, 250, 25):  # each is freed, and the next one takes its place in memory
        found = futures.still(np.full_like(history.frames[0], shade))
        still = frame_of(np.full_like(history.frames[0], shade))[:, None].expand(-1, 3, -1, -1, -1)
        torch.testing.assert_close(found, bundle.world_model.encode(still)[:, -1:])
