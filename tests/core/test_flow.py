"""Flow matching against the published schedule, and against a flow that is known in closed form.

Latents are N(m, s²) and independent. At noise level σ the best guess of the velocity is then the
linear function `exact_velocity`, and its flow takes the noise ε to m + s ε.
"""

import json
from pathlib import Path

import pytest
import torch

from acwm_core.errors import RecipeError
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.flow import TRAINING_POINTS, gaussian_weights, shifted_schedule
from acwm_core.model.objectives.full_sequence import FullSequence

PUBLISHED = json.loads((Path(__file__).parents[1] / "reference/flow_schedule.json").read_text())
MEAN, SPREAD = 0.7, 0.4
OBJECTIVES = [FullSequence, DiffusionForcing]


def per_frame(sigma):
    return sigma[:, :, None, None, None]


def exact_velocity(noisy, sigma):
    """E[ε − x | x_σ] of the Gaussian target."""
    signal, level = 1 - per_frame(sigma), per_frame(sigma)
    variance = (signal * SPREAD) ** 2 + level**2
    gain = (level - signal * SPREAD**2) / variance
    return -MEAN + gain * (noisy - signal * MEAN)


def exact_clean(noisy, sigma):
    return noisy - per_frame(sigma) * exact_velocity(noisy, sigma)


def noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def clean(clips, frames=4):
    return MEAN + SPREAD * noise(clips, frames, 2, 4, 4, seed=1)


def draws(clips, seed=0):
    """One generator that serves all clips in turn."""
    return [torch.Generator().manual_seed(seed)] * clips


class Recorder:
    """A denoiser that keeps the noise levels it is called with."""

    def __init__(self, denoise=exact_velocity):
        self.denoise, self.sigmas = denoise, []

    def __call__(self, noisy, sigma):
        self.sigmas.append(sigma)
        return self.denoise(noisy, sigma)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("weighting", ["gaussian", "none"])
def test_the_loss_is_least_at_the_exact_velocity(objective, weighting):
    """There its gradient vanishes, and what is left is the velocity's own uncertainty."""
    flow = objective(weighting=weighting, shift=3)
    scale, offset = torch.ones(1, requires_grad=True), torch.zeros(1, requires_grad=True)

    def denoise(noisy, sigma):
        return scale * exact_velocity(noisy, sigma) + offset

    loss = flow.error(denoise, clean(6000), draws(6000, 0))
    at_least = torch.autograd.grad(loss, (scale, offset))
    assert all(abs(gradient.item()) < 0.02 for gradient in at_least)

    levels = shifted_schedule(TRAINING_POINTS, 3)
    weights = gaussian_weights(levels) if weighting == "gaussian" else torch.ones_like(levels)
    signal = (1 - levels) * SPREAD
    covariance = levels - (1 - levels) * SPREAD**2
    left = 1 + SPREAD**2 - covariance**2 / (signal**2 + levels**2)
    assert loss.item() == pytest.approx((weights * left).mean().item(), rel=0.02)

    for wrong in (0.8, 1.2):
        scale.data.fill_(wrong)
        worse = flow.error(denoise, clean(6000), draws(6000, 0))
        (slope,) = torch.autograd.grad(worse, scale)
        assert worse > loss
        assert slope * (wrong - 1) > 0.01


def test_one_level_per_clip_or_one_per_frame():
    levels = {}
    for objective in OBJECTIVES:
        recorder = Recorder()
        flow = objective(shift=1)
        flow.error(recorder, clean(4000), draws(4000, 0))
        (sigma,) = recorder.sigmas
        assert torch.all(sigma[:, 0] == 0)
        levels[objective] = sigma[:, 1:]
    whole, each = levels[FullSequence], levels[DiffusionForcing]
    assert torch.equal(whole, whole[:, :1].expand_as(whole))
    assert torch.corrcoef(each.T).triu(1).abs().max() < 0.06  # four standard errors of 4000 draws
    for drawn in (whole, each):  # uniform at shift 1
        edges = torch.linspace(0, 1, 6)
        counts = torch.histogram(drawn[:, 1].contiguous(), edges).hist
        assert counts.min() > 700
        assert counts.max() < 900


def test_every_frame_is_weighed_by_its_own_level():
    """An error of one frame alone counts with that frame's weight."""
    flow = DiffusionForcing()
    target, recorder = clean(1), Recorder()
    sigmas = shifted_schedule(TRAINING_POINTS, 5.0)
    weights = gaussian_weights(sigmas)
    for frame in (1, 2, 3):

        def wrong_by_one(noisy, sigma, frame=frame):
            exact = (noisy - target) / per_frame(sigma).clamp(min=1e-3)
            exact[:, frame] += 1
            return exact

        recorder = Recorder(wrong_by_one)
        loss = flow.error(recorder, target, draws(1, 7))
        level = recorder.sigmas[0][0, frame].double()
        index = (sigmas - level).abs().argmin()
        assert loss.item() == pytest.approx(weights[index].item() / 3, rel=1e-3)


@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_sampling_converges_to_the_exact_flow(prediction):
    """Euler is of first order: twice the steps, half the error."""
    start, given = noise(8, 4, 2, 4, 4), clean(8)[:, :1]
    flow = FullSequence(prediction=prediction, shift=3)
    denoise = exact_velocity if prediction == "velocity" else exact_clean
    exact = MEAN + SPREAD * start[:, 1:]
    errors = []
    for steps in (25, 50, 100, 400):
        sampled = flow.sample(denoise, start, given, steps)
        assert torch.equal(sampled[:, :1], given)
        errors.append((sampled[:, 1:] - exact).square().mean().sqrt().item())
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, rel=0.1)
    assert errors[3] < 0.005


def test_the_default_is_the_published_number_of_evaluations():
    recorder = Recorder()
    FullSequence().sample(recorder, noise(2, 3, 2, 4, 4), clean(2, 1))
    levels = torch.stack([sigma[0, 1] for sigma in recorder.sigmas])
    assert len(levels) == 49
    torch.testing.assert_close(levels, shifted_schedule(50, 5.0)[:-1].float())


@pytest.mark.parametrize("known", [0, 1, 3])
def test_any_number_of_frames_may_be_given(known):
    start, given = noise(2, 4, 2, 4, 4), clean(2)[:, :known]
    recorder = Recorder()
    sampled = FullSequence().sample(recorder, start, given, steps=3)
    assert torch.equal(sampled[:, :known], given)
    assert all(torch.all(sigma[:, :known] == 0) for sigma in recorder.sigmas)
    assert all(torch.all(sigma[:, known:] > 0) for sigma in recorder.sigmas)


@pytest.mark.parametrize("points", [5, 10, 50])
def test_schedule_is_the_published_one(points):
    expected = torch.tensor(PUBLISHED[f"sigmas_{points}"], dtype=torch.float64)
    torch.testing.assert_close(shifted_schedule(points, 5.0), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("quantity", ["sigma", "weight"])
def test_training_points_and_weights_are_the_published_ones(quantity):
    sigma = shifted_schedule(TRAINING_POINTS, 5.0)
    ours = {"sigma": sigma, "weight": gaussian_weights(sigma)}[quantity]
    for index, expected in PUBLISHED[f"train_{quantity}_at_index"].items():
        assert ours[int(index)].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("loss_on", ["velocity", "clean"])
@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_loss_of_a_zero_prediction_is_the_variance_of_its_target(prediction, loss_on):
    """Predicting 0 in the space of the loss leaves E|target|²: 1 for unit data, 2 for ε − x."""
    unit = noise(512, 5, 2, 3, 3)
    flow = FullSequence(prediction=prediction, loss_on=loss_on, weighting="none", shift=1)

    def zero_in_loss_space(noisy, sigma):
        if prediction == loss_on:
            return torch.zeros_like(noisy)
        return noisy if loss_on == "velocity" else noisy / per_frame(sigma).clamp(min=1e-6)

    loss = flow.error(zero_in_loss_space, unit, draws(512, 3))
    assert loss.item() == pytest.approx(2.0 if loss_on == "velocity" else 1.0, rel=0.05)


@pytest.mark.parametrize("bad", [{"shift": 0.0}, {"steps": 0}])
def test_impossible_parameters_are_refused(bad):
    with pytest.raises(RecipeError, match=r"objective\."):
        FullSequence(**bad)
