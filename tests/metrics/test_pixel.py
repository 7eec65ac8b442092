"""Pixel metrics against the published values, hand calculations and scikit-image."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.errors import ShapeError
from acwm_core.evaluation.metric import Prediction
from acwm_core.plugins import catalog
from acwm_metrics.pixel import MSE, PSNR, SSIM, MaskedMSE, MeanPSNR
from acwm_metrics.plugin import LIBRARIES

REFERENCE = Path(__file__).parent.parent / "reference"
METRICS = {"mse": MSE, "m_mse": MaskedMSE, "psnr": PSNR, "ssim": SSIM}


def predicted(prediction, target):
    frames, _, height, width = target.shape
    card = EnvironmentCard(
        name="test",
        summary="",
        action=ActionSpec(names=("x",), units=("",), low=(-1.0,), high=(1.0,), kind="absolute"),
        frame_size=(height, width),
        fps=10,
        horizon=frames,
        factors=(),
        ood_shifts=(),
        state=(),
        instances=(),
        engine="",
    )
    return Prediction(
        video=prediction,
        target=target,
        actions=np.zeros((frames, 1), np.float32),
        states={},
        masks=np.zeros((frames, height, width), np.uint8),
        contacts=np.zeros((0, 3), np.int32),
        card=card,
    )


@pytest.fixture(scope="module")
def published():
    clips = load_file(REFERENCE / "metrics.safetensors")
    pairs = zip(clips["pred"].movedim(-1, 2), clips["gt"].movedim(-1, 2), strict=True)
    values = json.loads((REFERENCE / "metrics.json").read_text())
    return [predicted(prediction, target) for prediction, target in pairs], values


@pytest.fixture
def noisy():
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(5, 3, 12, 10, generator=generator)
    noise = torch.randn(5, 3, 12, 10, generator=generator)
    scale = torch.linspace(0.01, 0.2, 5)[:, None, None, None]
    return predicted((target + noise * scale).clamp(0, 1), target)


@pytest.mark.parametrize("name", METRICS)
def test_published_values_per_video(published, name):
    predictions, expected = published
    for clip, values in zip(predictions, expected["per_video"], strict=True):
        assert METRICS[name]().value(clip) == pytest.approx(values[name], abs=1e-6, rel=0)


@pytest.mark.parametrize("name", METRICS)
def test_published_values_pooled(published, name):
    predictions, expected = published
    metric = METRICS[name]()
    values = [metric.value(clip) for clip in predictions]
    weights = [metric.weight(clip) for clip in predictions]
    pooled = metric.summarise(values, weights)
    assert pooled == pytest.approx(expected["batch"][name], abs=1e-6, rel=0)


def test_masked_mse_by_hand():
    target = torch.zeros(2, 3, 1, 2)
    target[1, 2, 0, 0] = 0.5  # one channel of the left pixel moves
    prediction = target.clone()
    prediction[1, :, 0, 0] += 0.3  # an error where it moves …
    prediction[0, :, 0, 1] -= 0.4  # … and one where nothing does
    weights = 0.51 + 0.01
    frames = [0.01 * 0.16 / weights, 0.51 * 0.09 / weights]
    clip = predicted(prediction, target)
    np.testing.assert_allclose(MaskedMSE().per_frame(clip), frames, rtol=1e-6)
    assert MaskedMSE().value(clip) == pytest.approx(sum(frames) / 2, rel=1e-6)


def test_psnr_agrees_with_scikit_image_but_for_the_error_floor(noisy):
    def floored(true, seen):
        exact = peak_signal_noise_ratio(true.numpy(), seen.numpy(), data_range=1)
        return -10 * math.log10(10 ** (-exact / 10) + 1e-8)

    target, prediction = noisy.target.double(), noisy.video.double()
    frames = [floored(*pair) for pair in zip(target, prediction, strict=True)]
    np.testing.assert_allclose(PSNR().per_frame(noisy), frames, rtol=1e-7)
    assert PSNR().value(noisy) == pytest.approx(floored(target, prediction), rel=1e-7)
    assert PSNR().value(noisy) < np.mean(frames)  # decibels of the mean, not mean of decibels


def test_the_two_poolings_of_psnr():
    pooled = -10 * math.log10((1e-2 + 1e-4) / 2)
    assert PSNR().summarise([20.0, 40.0]) == pytest.approx(pooled)
    assert MeanPSNR().summarise([20.0, 40.0]) == pytest.approx(30)


@pytest.mark.parametrize("size", [(7, 7), (12, 10), (13, 40)])
def test_ssim_is_that_of_scikit_image(size):
    rng = np.random.default_rng(0)
    target = rng.random((4, 3, *size), np.float32)
    target[1] = 0.7  # flat: nothing but rounding varies
    prediction = np.clip(target + 0.1 * rng.standard_normal(target.shape, np.float32), 0, 1)
    prediction[2] = target[2][:, ::-1]  # as unlike as it gets
    prediction[3] = 0.2
    scores = SSIM().per_frame(predicted(torch.tensor(prediction), torch.tensor(target)))
    for true, seen, score in zip(
        target.astype(float), prediction.astype(float), scores, strict=True
    ):
        channels = [
            structural_similarity(*pair, win_size=7, data_range=1)
            for pair in zip(true, seen, strict=True)
        ]
        assert score == pytest.approx(np.mean(channels), abs=1e-12)


def test_a_perfect_prediction():
    target = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    clip = predicted(target.clone(), target)
    assert MSE().value(clip) == MaskedMSE().value(clip) == 0
    assert SSIM().value(clip) == pytest.approx(1)
    assert PSNR().value(clip) == pytest.approx(80)
    assert PSNR().summarise([80.0, 80.0]) == pytest.approx(80)


def test_a_still_video_weighs_every_pixel_alike():
    target = torch.full((3, 3, 8, 8), 0.5)
    clip = predicted(target + 0.1 * torch.rand(3, 3, 8, 8), target)
    assert MaskedMSE().value(clip) == pytest.approx(MSE().value(clip))


@pytest.mark.parametrize("metric", [MSE, MaskedMSE, PSNR, SSIM])
def test_half_precision_inside_autocast_changes_nothing(noisy, metric):
    expected = metric().value(noisy)
    with torch.autocast("cpu", torch.bfloat16):
        assert metric().value(noisy) == expected


@pytest.mark.parametrize("metric", [MSE, MaskedMSE, PSNR, SSIM])
def test_clips_of_different_shape_are_refused(metric):
    clip = predicted(torch.zeros(2, 3, 8, 8), torch.zeros(3, 3, 8, 8))
    with pytest.raises(ShapeError, match=r"\[2, 3, 8, 8\] with \[3, 3, 8, 8\]"):
        metric().value(clip)


def test_ssim_refuses_frames_below_its_window():
    clip = predicted(torch.zeros(2, 3, 6, 9), torch.zeros(2, 3, 6, 9))
    with pytest.raises(ShapeError, match="6×9"):
        SSIM().value(clip)


SQUARES = "mse", "m_mse", "energy_score"  # small numbers, which tables show in thousandths


def test_metrics_say_how_tables_show_them():
    infos = {
        component.name: component.create().info
        for component in catalog().registry("metric")
        if component.plugin == "acwm_metrics" and component.name not in LIBRARIES
    }
    titles = {name: info.title for name, info in infos.items() if info.group == "Pixels"}
    assert titles == {
        "mse": "MSE",
        "m_mse": "M-MSE",
        "psnr": "PSNR",
        "psnr_mean": "PSNR mean",
        "ssim": "SSIM",
    }
    others = ("lpips", "fvd", "mask_iou", "position_error_px", "contact_timing_frames")
    assert [infos[name].title for name in others] == [
        "LPIPS",
        "FVD",
        "Mask IoU",
        "Position error (px)",
        "Contact timing frames",
    ]
    pixels = {name for name, info in infos.items() if info.reads == "pixels"}
    assert pixels == {*titles, "lpips", "fvd", "response", "energy_score", "spread_skill"}
    assert {name for name, info in infos.items() if info.factor == 1000} == {*SQUARES}
    assert min(infos, key=lambda name: infos[name].rank) == "psnr"
    groups = {"Pixels", "Perception", "States", "Physics", "Contacts", "Actions", "Draws"}
    assert {info.group for info in infos.values()} == groups
