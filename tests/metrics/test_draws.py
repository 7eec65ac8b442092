"""Metrics of draws agree with closed forms, and the scores of draws with those of single ones."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from acwm_core.env.physics import Observation, Physics, Reading
from acwm_core.errors import RecipeError
from acwm_core.evaluation.draws import metrics_for, score_draws
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.score import score
from acwm_core.plugins import catalog
from tests.metrics.seeing import Oracle, card_of

CARD = card_of(("background", "ball"))
BALL = Physics(readings=(Reading("position", "position", ("ball",)),))


def metric(name):
    return catalog().create("metric", name)


def prediction(video, target, **known):
    frames = len(target)
    states = {"position": np.zeros((frames, 1, 2)), **known.pop("states", {})}
    masks = np.zeros((frames, *target.shape[2:]), np.uint8)
    contacts = np.zeros((0, 3), np.int32)
    actions = np.zeros((frames, 1), np.float32)
    return Prediction(video, target, actions, states, masks, contacts, CARD, **known)


def grey(values):
    """One grey pixel for each number, `[T, 3, 1, 1]`, so that frames differ as numbers do."""
    return torch.as_tensor(np.asarray(values, np.float32))[:, None, None, None].expand(-1, 3, 1, 1)


def ensemble(videos, target):
    draws = [prediction(video, target) for video in videos]
    return replace(draws[0], draws=tuple(draws))


@pytest.mark.parametrize("number", [2, 16])
@pytest.mark.parametrize("place", [0.0, 0.9])
def test_the_energy_score_of_gaussian_draws_is_the_closed_form(number, place):
    """In one dimension it is the CRPS; the mean is the same for any number of draws."""
    rng, sigma, frames = np.random.default_rng(number), 0.2, 40_000 // number
    draws = sigma * rng.normal(size=(number, frames))
    found = metric("energy_score").per_frame(
        ensemble(map(grey, draws), grey(np.full(frames, sigma * place)))
    )
    density = place * (2 * stats.norm.cdf(place) - 1) + 2 * stats.norm.pdf(place)
    expected = sigma * (density - 1 / np.sqrt(np.pi))
    assert found.mean() == pytest.approx(expected, abs=4 * found.std() / np.sqrt(frames))


def test_the_energy_score_of_one_prediction_is_its_distance():
    video, target = torch.rand(2, 4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    alone = prediction(video, target)
    distance = (video - target).square().mean((1, 2, 3)).sqrt().numpy()
    assert metric("energy_score").per_frame(alone) == pytest.approx(distance)
    assert metric("energy_score").per_frame(ensemble([video], target)) == pytest.approx(distance)


@pytest.mark.parametrize(("wide", "number"), [(1.0, 2), (1.0, 8), (0.5, 8)])
def test_spread_to_error_is_one_where_the_truth_could_be_a_draw(wide, number):
    rng, frames = np.random.default_rng(3), 20_000
    draws, truth = wide * rng.normal(size=(number, frames)), rng.normal(size=frames)
    clip = ensemble(map(grey, draws), grey(truth))
    spread, error = (1 + 1 / number) * wide**2, 1 + wide**2 / number
    assert metric("spread_skill").value(clip) == pytest.approx((spread / error) ** 0.5, abs=0.02)


def test_spread_to_error_sums_clips_up_as_one():
    rng, one = np.random.default_rng(4), metric("spread_skill")
    clips = [(size * rng.normal(size=(3, 50)), rng.normal(size=50)) for size in (0.1, 2.0)]
    made = [ensemble(map(grey, draws), grey(truth)) for draws, truth in clips]
    joined = ensemble(
        map(grey, np.concatenate([draws for draws, _ in clips], 1)),
        grey(np.concatenate([truth for _, truth in clips])),
    )
    found = one.summed_up([one.value(c) for c in made], [one.weight(c) for c in made])
    assert found == pytest.approx(one.value(joined))


def test_a_model_that_draws_nothing_has_no_spread():
    target = torch.rand(6, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    alone = ensemble([target.flip(0)], target)
    assert metric("spread_skill").value(alone) == 0
    assert np.isnan(metric("spread_skill").value(prediction(target.flip(0), target)))


def seen_at(places, true):
    """A clip of one ball whose draws are seen at `places` `[N, T, 2]` and which is at `true`."""
    target = torch.zeros(len(true), 3, 4, 4)

    def draw(each):
        oracle = Oracle(CARD, BALL, Observation(masks, {"position": each[:, None]}))
        states = {"position": true[:, None]}
        return prediction(target, target, states=states, estimator=oracle)

    masks = np.zeros((len(true), 4, 4), np.uint8)
    draws = tuple(map(draw, places))
    return replace(draws[0], draws=draws)


@pytest.mark.parametrize("number", [2, 5, 16])
@pytest.mark.parametrize("share", [50, 80, 95])
def test_a_calibrated_ensemble_covers_what_it_should(number, share):
    rng, frames = np.random.default_rng(share), 8000
    middle = rng.normal(size=(1, frames, 2))  # unknown to the interval
    *draws, true = middle + 0.01 * rng.normal(size=(number + 1, frames, 2))
    found = metric(f"coverage_{share}").value(seen_at(np.stack(draws), true))
    assert found == pytest.approx(share / 100, abs=0.015)


def test_too_narrow_an_ensemble_covers_less_and_a_single_draw_nothing():
    rng = np.random.default_rng(0)
    draws, true = 0.3 * rng.normal(size=(8, 2000, 2)), rng.normal(size=(2000, 2))
    sigma = 0.3 * (1 + 1 / 8) ** 0.5
    reach = stats.t.ppf(0.9, 7) * sigma
    right = 2 * stats.norm.cdf(reach / (1 + 0.3**2 / 8) ** 0.5) - 1
    assert metric("coverage_80").value(seen_at(draws, true)) == pytest.approx(right, abs=0.03)
    assert metric("coverage_80").value(seen_at(draws[:1], true)) == 0


def some_draws(number):
    generator = torch.Generator().manual_seed(5)
    target = torch.rand(6, 3, 8, 8, generator=generator)
    noise = 0.1 * torch.randn(number, 6, 3, 8, 8, generator=generator)
    return [prediction(target + each, target) for each in noise]


METRICS = ("psnr", "mse", "m_mse", "energy_score", "spread_skill")


def test_the_best_of_more_draws_is_never_worse():
    metrics = {name: metric(name) for name in METRICS}
    draws = some_draws(6)
    best = [score_draws(draws[:number], metrics)[2] for number in range(1, 7)]
    for one, more in itertools.pairwise(best):
        assert more.values["mse"] <= one.values["mse"]
        assert more.values["psnr"] >= one.values["psnr"]
    alone = [score(draw, metrics).values["mse"] for draw in draws]
    assert best[-1].values["mse"] == min(alone) < max(alone)


def test_draws_are_scored_one_by_one_and_by_their_mean():
    metrics, draws = {name: metric(name) for name in METRICS}, some_draws(4)
    one, mean, best = score_draws(draws, metrics)
    assert [each.kind for each in (one, mean, best)] == ["model", "mean_of_draws", "best_of_draws"]
    alone = np.array([score(draw, metrics).values["mse"] for draw in draws])
    assert one.values["mse"] == pytest.approx(alone.mean())
    assert one.values["psnr"] == pytest.approx(-10 * np.log10(alone.mean()), abs=1e-3)
    video = torch.stack([draw.video for draw in draws]).mean(0)
    of_mean = score(replace(draws[0], video=video), metrics)
    assert mean.values["mse"] == pytest.approx(of_mean.values["mse"])
    assert mean.values["mse"] < best.values["mse"]
    assert np.isfinite(one.values["energy_score"])
    assert np.isnan(mean.values["energy_score"])


def test_a_single_draw_is_its_own_mean_and_best():
    metrics, (draw,) = {name: metric(name) for name in METRICS}, some_draws(1)
    one, *others = score_draws([draw], metrics)
    plain = score(draw, {name: metrics[name] for name in METRICS[:3]})
    for each in (one, *others):
        assert {n: v for n, v in each.values.items() if n in plain.values} == plain.values
        assert {n: v for n, v in each.curves.items() if n in plain.values} == plain.curves
    assert one.values["spread_skill"] == 0


def test_one_draw_that_is_not_finite_counts_as_infinitely_bad():
    metrics, draws = {name: metric(name) for name in METRICS}, some_draws(3)
    draws[1] = replace(draws[1], video=draws[1].video * np.nan)
    one, mean, best = score_draws(draws, metrics)
    assert [each.failed for each in (one, mean, best)] == [True, True, False]
    assert one.values["mse"] == mean.values["mse"] == np.inf
    assert one.values["energy_score"] == np.inf
    assert np.isfinite(best.values["mse"])


def test_metrics_of_draws_alone_cannot_rank_clips():
    with pytest.raises(RecipeError, match="energy_score"):
        metrics_for({"energy_score": metric("energy_score")}, 4)
