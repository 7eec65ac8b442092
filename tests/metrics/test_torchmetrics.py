"""Metrics of torchmetrics as ours, and ours as `torchmetrics.Metric`."""

import math

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.image import PeakSignalNoiseRatio

from acwm_core.checks import check_metric
from acwm_core.errors import PluginError, RecipeError, ShapeError
from acwm_core.evaluation.metric import SetMetric
from acwm_core.evaluation.score import build_metrics
from acwm_core.plugins import catalog
from acwm_metrics.torchmetrics import TorchMetric, as_torchmetric
from tests.metrics.seeing import boxes, clip
from tests.metrics.test_pixel import predicted

IMAGE = "torchmetrics.image"
PSNR, SSIM = f"{IMAGE}.PeakSignalNoiseRatio", f"{IMAGE}.StructuralSimilarityIndexMeasure"


def videos(clips=5, frames=4, size=32, seed=0):
    """True clips, and predictions that are off by more from clip to clip."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(clips, frames, 3, size, size, generator=generator)
    noise = torch.randn(target.shape, generator=generator)
    scale = torch.linspace(0.02, 0.3, clips)[:, None, None, None, None]
    return (target + scale * noise).clamp(0, 1), target


def test_its_scores_are_those_of_torchmetrics():
    prediction, target = (video[0] for video in videos())
    metric = TorchMetric(SSIM, kernel_size=5)
    functional = [
        structural_similarity_index_measure(*pair, kernel_size=5, data_range=1.0).item()
        for pair in zip(prediction.split(1), target.split(1), strict=True)
    ]
    clip = predicted(prediction, target)
    np.testing.assert_allclose(metric.per_frame(clip), functional, rtol=1e-6)
    assert metric.value(clip) == pytest.approx(np.mean(functional), rel=1e-5)
    pooled = TorchMetric(PSNR).value(clip)
    assert pooled == pytest.approx(catalog().create("metric", "psnr").value(clip), abs=1e-3)


def test_it_says_what_it_is():
    metrics = build_metrics([PSNR, {"name": f"{IMAGE}.SpectralAngleMapper", "as": "sam"}])
    assert list(metrics) == ["peak_signal_noise_ratio", "sam"]
    info = [metric.info for metric in metrics.values()]
    assert [each.title for each in info] == ["Peak signal noise ratio", "Sam"]
    assert [each.higher_is_better for each in info] == [True, False]
    assert {each.reads for each in info} == {"pixels"}
    assert metrics["sam"].provenance()["class"] == f"{IMAGE}.SpectralAngleMapper"


@pytest.mark.parametrize("target", [SSIM, f"{IMAGE}.SpatialCorrelationCoefficient"])
def test_metrics_of_torchmetrics_conform(target):
    failed = [each for each in check_metric(lambda: TorchMetric(target)) if not each.passed]
    assert failed == []


@pytest.mark.parametrize(
    ("target", "params", "message"),
    [
        ("", {}, "name a class of torchmetrics"),
        (f"{IMAGE}.NoSuchThing", {}, "it does not exist or needs a package"),
        ("torchmetrics.utilities.dim_zero_cat", {}, "not a metric of torchmetrics"),
        (PSNR, {"data_range": "wide"}, "cannot be made"),
        (f"{IMAGE}.TotalVariation", {}, "does not compare pictures: it takes img"),
    ],
)
def test_what_cannot_score_pictures_is_refused(target, params, message):
    with pytest.raises(RecipeError, match=message):
        TorchMetric(target, **params)


@pytest.mark.parametrize(
    "target",
    [f"{IMAGE}.MultiScaleStructuralSimilarityIndexMeasure", f"{IMAGE}.QualityWithNoReference"],
)
def test_what_takes_no_such_frames_is_left_out_with_a_sentence(target):
    card = predicted(*(video[0] for video in videos())).card
    assert f"{target} takes no frames of 32×32" in TorchMetric(target).unavailable(card, None)
    assert TorchMetric(SSIM).unavailable(card, None) is None


@pytest.mark.parametrize("name", ["mse", "m_mse", "psnr", "psnr_mean", "ssim"])
def test_ours_sum_up_as_an_evaluation_does(name):
    prediction, target = videos()
    metric, ours = as_torchmetric(name), catalog().create("metric", name)
    assert math.isnan(metric.compute())
    for batch in (slice(0, 2), slice(2, 4)):
        metric.update(prediction[batch], target[batch])
    metric.update(prediction[4], target[4])
    clips = [predicted(*pair) for pair in zip(prediction, target, strict=True)]
    values, weights = ([f(each) for each in clips] for f in (ours.value, ours.weight))
    assert metric.compute().item() == pytest.approx(ours.summarise(values, weights), rel=1e-6)
    metric.reset()
    metric.update(prediction[0], target[0])
    assert metric.compute().item() == pytest.approx(values[0], rel=1e-6)


def test_our_pooled_psnr_is_that_of_torchmetrics():
    prediction, target = videos()
    theirs, ours = PeakSignalNoiseRatio(data_range=1.0), as_torchmetric("psnr")
    for metric in (theirs, ours):
        metric.update(prediction, target)
    assert ours.compute().item() == pytest.approx(theirs.compute().item(), abs=1e-4)


def test_two_processes_have_the_score_of_all_clips():
    prediction, target = videos()
    whole, halves = as_torchmetric("psnr"), [as_torchmetric("psnr") for _ in range(2)]
    whole.update(prediction, target)
    for half, part in zip(halves, (slice(0, 1), slice(1, 5)), strict=True):
        half.update(prediction[part], target[part])
    gathered = {
        "scores": [torch.cat(half.scores) for half in halves],
        "weights": [torch.cat(half.weights) for half in halves],
    }
    first = halves[0]
    first.dist_sync_fn = lambda state, group=None: next(
        found for found in gathered.values() if torch.equal(found[0], state)
    )
    first.distributed_available_fn = lambda: True
    assert first.compute().item() == pytest.approx(whole.compute().item(), rel=1e-9)


class Colours(SetMetric):
    """Squared distance of mean colours."""

    name = "colours"
    reads = "pixels"

    def features(self, prediction):
        return np.stack([c.mean((0, 2, 3)).numpy() for c in (prediction.video, prediction.target)])

    def distance(self, features):
        made, true = features.mean(0)
        return float(((made - true) ** 2).sum())


def test_metrics_of_sets_and_of_states_work_too():
    prediction, target = videos()
    metric, features = as_torchmetric(Colours()), []
    metric.update(prediction, target)
    for pair in zip(prediction, target, strict=True):
        features.append(Colours().features(predicted(*pair)))
    assert metric.compute().item() == pytest.approx(Colours().distance(np.stack(features)))
    with pytest.raises(PluginError, match="mask_iou cannot be measured: it reads states"):
        as_torchmetric("mask_iou")
    seen = clip(seen=boxes(3, (4, 4)), names=("box",))
    with pytest.raises(PluginError, match="cannot be measured"):
        as_torchmetric("mask_iou", card=seen.card)


def test_clips_that_do_not_belong_together_are_refused():
    prediction, target = videos()
    with pytest.raises(ShapeError, match="4 predicted clips, 5 true ones and 5 episodes"):
        as_torchmetric("mse").update(prediction[:4], target)
    for wrong in ((target * 255).byte(), target * 2 - 1):
        with pytest.raises(ShapeError, match=r"255|in \[0, 1\]"):
            as_torchmetric("ssim").update(wrong, wrong)
    with pytest.raises(PluginError, match="lpips cannot be measured: it needs weights"):
        as_torchmetric("lpips").update(prediction, target)
