"""Crafted predictions of every world come out in the order that they should, in all metrics."""

import itertools
import math
from dataclasses import replace

import pytest

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.score import estimator_for
from acwm_core.plugins import catalog
from acwm_metrics.plugin import PHYSICS, PIXELS
from tests.metrics.crafted import CRAFTED

FRAMES = 66

WORLDS = (
    "reacher",
    "push_cube",
    "stack_cube",
    "push_rope",
    "cloth_move",
    "robot_arm",
    "push_sand",
    "pour_water",
)

COMPARED = ("mse", "m_mse", "psnr", "ssim", "position_error", "position_error_px", "mask_iou")
"""Metrics that compare with the truth at the same time, closely enough for frames to count."""

SLACK = 0.02
"""What relative difference counts as none: estimators read no frame exactly like another."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(world, marks=pytest.mark.ci) for world in WORLDS],
)
def scores(request):
    pytest.importorskip("taichi" if request.param in ("push_sand", "pour_water") else "mujoco")
    environment = make_environment(request.param, {"size": 64})
    spec = EpisodeSpec(request.param, "ind_test", 0, seed=5, options={"size": 64})
    episode = simulate(environment, spec, frames=FRAMES)
    environment.close()
    estimator = estimator_for(environment.card)
    return scores_of(Prediction.truth(episode, environment.card, estimator))


def scores_of(truth):
    """How bad each crafted prediction is, and its share that is scored, by metric and craft."""
    found = {}
    predictions = {"truth": truth}
    for name, make in CRAFTED.items():
        predictions[name] = replace(truth, video=make(truth.target).contiguous(), kind="model")
    for name in (*PIXELS, *PHYSICS):
        metric = catalog().create("metric", name)
        if not metric.of_branches and not metric.unavailable(truth.card, truth.estimator):
            sign = -1 if metric.higher_is_better else 1
            for craft, each in predictions.items():
                curve = metric.curve(each)
                value, _ = metric.scored(each, curve)
                found[name, craft] = sign * value, metric.coverage(each, curve)
    return found


def metrics_of(scores, *asked):
    """Those of the asked metrics, or all, that this world has."""
    return [
        name for name in dict.fromkeys(each for each, _ in scores) if name in (asked or (name,))
    ]


def no_better(scores, metric, one, other):
    """Whether `one` is no better than `other`, where both have a score above the noise floor."""
    first, second = scores[metric, one][0], scores[metric, other][0]
    unknown = math.isnan(first) or math.isnan(second)
    noise = 0 < second <= scores[metric, "truth"][0] * (1 + SLACK)
    return unknown or noise or first >= second - SLACK * abs(second)


def wrong(scores, metrics, *order):
    """The neighbours in an order from best to worst, in these metrics, that are the other way."""
    return [
        (name, better, worse, scores[name, better], scores[name, worse])
        for name in metrics
        for better, worse in itertools.pairwise(order)
        if not no_better(scores, name, worse, better)
    ]


def test_the_later_the_worse(scores):
    order = "truth", "one_frame_late", "late", "frozen"
    assert wrong(scores, metrics_of(scores, *COMPARED), *order) == []
    assert wrong(scores, metrics_of(scores, "sharpness"), *order) == []


def test_what_is_lawful_is_so_at_any_time(scores):
    laws = metrics_of(scores, "permanence", "permanence_after_contact", "violations")
    for craft in ("one_frame_late", "late", "frozen"):
        assert wrong(scores, laws, craft, "truth") == []


def test_vanishing_is_no_better_than_standing_still(scores):
    every = metrics_of(scores)
    assert wrong(scores, every, "frozen", "black") == []
    assert wrong(scores, every, "stopped", "vanishing") == []


def test_vanishing_is_worse_than_being_late(scores):
    asked = {*metrics_of(scores)} - {"penetration", "contact_timing", "contact_timing_frames"}
    for craft in ("vanishing", "black"):  # where each stops, what moves to and fro may be nearer
        assert wrong(scores, metrics_of(scores, *asked), "late", craft) == []
    turned = metrics_of(scores, "orientation_error")
    assert wrong(scores, turned, "one_frame_late", "flickering", "black") == []


@pytest.mark.parametrize(("craft", "most"), [("black", 0.05), ("dark", 0.05), ("vanishing", 0.3)])
def test_objects_that_cannot_be_seen_are_not_there(scores, craft, most):
    assert -scores["permanence", craft][0] <= most
    assert scores["violations", craft][0] == 1
    if craft != "dark":  # what is dark may still be found
        for name in metrics_of(scores, "position_error", "orientation_error", "contact_recall"):
            assert scores[name, craft][1] <= most


def test_haze_noise_and_a_picture_without_what_moves(scores):
    assert (
        wrong(scores, metrics_of(scores, "mask_iou", "sharpness"), "truth", "hazy", "median") == []
    )
    assert wrong(scores, metrics_of(scores, "sharpness"), "truth", "noisy", "black") == []
    for craft in ("hazy", "noisy"):
        assert scores["sharpness", craft][0] > -0.9


def test_what_is_elsewhere(scores):
    placed = metrics_of(scores, "position_error", "position_error_px", "mask_iou", "psnr")
    for craft in ("shifted", "mirrored"):
        assert wrong(scores, placed, "one_frame_late", craft) == []


def test_colours_and_numbers(scores):
    for craft in ("late", "mirrored", "noisy"):
        assert wrong(scores, ["colour_error"], craft, "swapped", "black") == []
    counted = metrics_of(scores, "object_count_error")
    assert wrong(scores, counted, "late", "vanishing", "black") == []
