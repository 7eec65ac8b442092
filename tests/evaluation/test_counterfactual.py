"""Counterfactual response: known models stand where theory puts them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from acwm_core.checks.disc import Disc
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.environment import ActionSpec
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import Clip, as_clip
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.score import build_metrics
from acwm_interventions.counterfactual import (
    SIZES,
    counterfactual,
    max_branches,
    plan_branches,
    simulate_branches,
)
from acwm_interventions.interventions import asked_clips
from acwm_metrics.response import Response

FRAMES, CLIPS = 10, 2
KINDS = ["another", "still", "reversed", "mirrored", "vx", "vy"]


SIMULATED = {}
"""Clips of `Disc`, by frame size, seed and actions."""


class Episodes(list):
    """Episodes in memory, with no folder that could keep anything."""

    path = Path("/nowhere")

    def actions(self, index):
        return self[index].actions


class Known:
    """A world model that makes each video from the true one of the same actions.

    Args:
        predict: from the true factual video, the true video of the actions and the clip's seed to
            the prediction.
    """

    device = torch.device("cpu")

    def __init__(self, environment, specs, predict):
        self.environment, self.specs, self.predict = environment, specs, predict
        self.factual = {}  # the first actions of each seed

    def rollout_chunks(self, given, actions, *, mode, steps, seeds):
        videos = []
        for rows, seed in zip(actions.numpy(), seeds, strict=True):
            factual = self.factual.setdefault(seed, rows)
            true, usual = (self._true(seed, each) for each in (rows, factual))
            videos.append(self.predict(usual, true, seed))
        yield torch.stack(videos)

    def children(self):
        return []

    def codec(self, video):
        return video * 0.5 + 0.25

    def _true(self, seed, rows):
        key = self.environment.frame_size, seed, rows.tobytes()
        if key not in SIMULATED:
            made = simulate(self.environment, self.specs[seed], rows, frames=len(rows))
            SIMULATED[key] = as_clip(made.video)
        return SIMULATED[key]


@pytest.fixture(scope="module")
def world():
    environment = Disc(size=(32, 48))
    specs = [EpisodeSpec("disc", "ind_test", index) for index in range(CLIPS)]
    episodes = Episodes(simulate(environment, spec) for spec in specs)
    plans = [Clip("ind_test", i, 0, 24, donor=1 - i, donor_start=0, seed=i) for i in range(2)]
    return environment, specs, episodes, plans


def ask(world, predict):
    environment, specs, episodes, plans = world
    model = Known(environment, specs, predict)
    config = EvaluationConfig(batch_size=3, device="cpu")
    evaluator = Evaluator(model, environment.card, {}, config)
    fans = simulate_branches(environment, plans, episodes, FRAMES)
    return counterfactual(evaluator, {"response": Response()}, fans)


def response(found, row="model"):
    return found.rows[row]["response"].value


def simulator(factual, true, seed):
    return true


def test_the_simulator_has_one(world):
    found, videos = ask(world, simulator)
    assert response(found) == pytest.approx(1, abs=1e-9)
    assert list(found.kinds) == KINDS
    assert found.clips == CLIPS
    assert found.frames == FRAMES
    assert found.branches == CLIPS * max_branches(Disc.card.action)
    for kind in KINDS:
        assert found.kinds[kind]["model"]["response"].value == pytest.approx(1, abs=1e-9)
        assert found.gain[kind]["model"] == pytest.approx(1)
        assert found.residual[kind]["model"] == pytest.approx(0, abs=1e-9)
    names = [record.kind for record, _ in videos]
    assert names == ["branch:factual", *(f"branch:{kind}" for kind in KINDS)]
    assert all(len(frames) == FRAMES for _, frames in videos)


def blurred_noise(seed):
    return 0.2 * torch.randn(FRAMES, 3, 32, 48, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    "blind",
    [
        lambda factual, true, seed: factual[:1].expand_as(factual),
        lambda factual, true, seed: factual,
        lambda factual, true, seed: (factual + blurred_noise(seed)).clamp(0, 1),
    ],
    ids=["first frame", "insensitive", "insensitive and noisy"],
)
def test_a_model_that_ignores_actions_has_zero(world, blind):
    found, _ = ask(world, blind)
    assert response(found) == pytest.approx(0, abs=1e-12)
    assert found.gain["all"]["model"] == 0
    assert found.residual["all"]["model"] == 0


@pytest.mark.parametrize(
    ("gain", "score"), [(0.5, 0.75), (1.5, 0.75), (2.0, 0.0), (-1.0, -3.0), (0.9, 0.99)]
)
def test_too_weak_too_strong_and_opposite_responses_are_where_theory_puts_them(world, gain, score):
    def predict(factual, true, seed):
        return factual + gain * (true - factual)

    found, _ = ask(world, predict)
    assert response(found) == pytest.approx(score, abs=1e-6)
    assert found.gain["all"]["model"] == pytest.approx(gain, abs=1e-6)
    assert found.residual["all"]["model"] == pytest.approx(0, abs=1e-6)


def test_noise_that_differs_between_branches_is_a_wrong_response(world):
    calls = iter(range(10_000))

    def predict(factual, true, seed):
        return factual + 0.2 * torch.randn(
            factual.shape, generator=torch.Generator().manual_seed(next(calls))
        )

    found, _ = ask(world, predict)
    assert response(found) < -0.5
    assert found.residual["all"]["model"] > 0.5
    assert abs(found.gain["all"]["model"]) < 0.1


def test_a_response_at_a_wrong_place_is_worse_than_none(world):
    found, _ = ask(world, lambda factual, true, seed: factual + (true - factual).flip(-1))
    assert response(found) < 0


def test_the_score_is_made_of_gain_and_residual(world):
    def predict(factual, true, seed):
        return 0.3 * factual + 0.6 * true + 0.1 * true.flip(-1)

    found, _ = ask(world, predict)
    for kind in KINDS:
        gain, residual = found.gain[kind]["model"], found.residual[kind]["model"]
        score = found.kinds[kind]["model"]["response"].value
        assert score == pytest.approx(1 - (1 - gain) ** 2 - residual, abs=1e-9)


def test_the_codec_is_a_row_of_its_own(world):
    found, _ = ask(world, simulator)
    assert list(found.rows) == ["model", "codec"]
    assert response(found, "codec") == pytest.approx(0.75, abs=1e-6)  # it halves all contrasts


def test_response_curves_grow_with_size_and_time_and_show_what_is_missing(world):
    found, _ = ask(world, lambda factual, true, seed: factual + 0.5 * (true - factual))
    assert [(c.dimension, c.size) for c in found.curves] == [
        (name, size) for name in ("vx", "vy") for size in SIZES
    ]
    for small, large in (found.curves[:2], found.curves[2:]):
        assert 0 < small.shift < large.shift <= SIZES[-1] + 1e-6
        assert small.truth[0] == 0
        assert small.rows["model"][0] is None
        assert small.truth[1] < large.truth[1] < max(large.truth)
        assert max(small.truth) < max(large.truth)
        np.testing.assert_allclose(large.rows["model"][1:], np.array(large.truth[1:]) / 2)


def test_branches_stay_within_bounds_and_are_what_they_are_called():
    spec = ActionSpec(("a", "b"), ("m", ""), (-1.0, 0.0), (1.0, 4.0), "absolute")
    rng = np.random.default_rng(0)
    actions = np.append(rng.uniform(spec.low, spec.high, (8, 2)), [[0, 0]], 0).astype(np.float32)
    other, still = np.append(actions[3:], actions[:3] * 0, 0), np.float32([0.5, 1.0])
    branches = {(b.kind, b.size): b.actions for b in plan_branches(actions, other, still, spec)}
    assert len(branches) == max_branches(spec)
    for rows in branches.values():
        assert rows.shape == actions.shape
        assert not rows[-1].any()
        assert np.all((rows[:-1] >= spec.low) & (rows[:-1] <= spec.high))
    assert np.array_equal(branches["still", 0][:-1], np.tile(still, (8, 1)))
    assert np.array_equal(branches["reversed", 0][:-1], actions[-2::-1])
    inside = np.clip(2 * still - actions[:-1], spec.low, spec.high)
    np.testing.assert_allclose(branches["mirrored", 0][:-1], inside)
    for size in SIZES:
        change = branches["b", size] - actions
        assert not change[:, 0].any()
        assert np.abs(change[:, 1]).max() <= 2 * size + 1e-6  # half the range of b is 2
    assert len({np.sign(branches["b", size] - actions)[:-1, 1].sum() > 0 for size in SIZES}) == 1


def test_a_branch_that_changes_nothing_is_not_asked_for():
    spec = ActionSpec(("a",), ("",), (-1.0,), (1.0,), "delta")
    idle = np.zeros((5, 1), np.float32)
    kinds = [b.kind for b in plan_branches(idle, idle, idle[0], spec)]
    assert kinds == ["a"] * len(SIZES)


def test_only_clips_that_begin_with_their_episode_are_asked_about():
    starts = [(0, 0), (0, 12), (1, 0), (2, 0)]
    plans = [Clip("ind_test", e, s, 9, donor=3, donor_start=0, seed=1) for e, s in starts]
    evaluator = Evaluator(None, Disc.card, {}, EvaluationConfig(counterfactual_episodes=2))
    found = asked_clips(evaluator.config, {"ind_test": plans})["counterfactual"]
    assert [plan.episode for plan in found["ind_test"]] == [0, 1]


def test_push_cubes_pusher_stays_where_it_is_on_the_branch_still():
    environment = make_environment("push_cube", {"size": 64})
    episode = simulate(environment, EpisodeSpec("push_cube", "ind_test", 1), frames=8)
    episodes = Episodes([episode, episode])
    plan = Clip("ind_test", 0, 0, 8, donor=1, donor_start=0, seed=0)
    ((branches, factual),) = simulate_branches(environment, [plan], episodes, 8)
    made = dict(zip([branch.kind for branch in branches], factual.branches, strict=True))
    places = made["still"].states["pusher_position"]
    assert np.abs(places - places[0]).max() < 1e-4
    assert torch.equal(factual.video, as_clip(episode.video))


def test_an_evaluation_asks_and_says_what_it_could_not(evaluated):
    summary = Summary.read(evaluated)
    assert "no perturbed start" in summary.left_out["perturbed"]
    for split in summary.splits.values():
        assert split.counterfactual.clips == 2
        assert split.counterfactual.rows["model"]["response"].value is not None
        assert split.predictability is None
    branches = [video for video in summary.videos if video.pick == "counterfactual"]
    assert {video.split for video in branches} == {"ind_test", "ood_test"}
    assert all((evaluated / "evaluation" / "videos" / v.file).exists() for v in branches)


def test_metrics_of_branches_have_a_list_of_their_own():
    with pytest.raises(RecipeError, match=r"response belongs in evaluation\.counterfactual_m"):
        build_metrics(["mse", "response"])
    with pytest.raises(RecipeError, match=r"psnr belongs in evaluation\.metrics, not"):
        build_metrics(["psnr"], of_branches=True)


def test_without_branches_there_is_no_response():
    clip, nothing = torch.zeros(3, 3, 8, 8), np.zeros((3, 8, 8), np.uint8)
    prediction = Prediction(clip, clip, np.zeros((3, 2)), {}, nothing, np.zeros((0, 3)), Disc.card)
    assert np.isnan(Response().value(prediction))
    assert Response().weight(prediction) == 0
