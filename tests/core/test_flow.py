"""The flow against the published schedule, against algebra, and against an exact denoiser."""

import json
from pathlib import Path

import pytest
import torch

from acwm_core.errors import RecipeError
from acwm_core.model.objectives.flow import (
    TRAINING_POINTS,
    gaussian_weights,
    mix,
    shifted_schedule,
)
from acwm_core.model.objectives.full_sequence import FullSequence

PUBLISHED = json.loads((Path(__file__).parents[1] / "reference/flow_schedule.json").read_text())


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


def latents(seed=0, batch=3, frames=4):
    return torch.randn(batch, frames, 2, 3, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_conversions_invert_the_path(prediction):
    clean, noise = latents(0), latents(1)
    sigma = torch.rand(3, 4, generator=torch.Generator().manual_seed(2)) * 0.9 + 0.05
    noisy = mix(clean, noise, sigma)
    flow = FullSequence(prediction=prediction)
    perfect = clean if prediction == "clean" else noise - clean
    torch.testing.assert_close(flow.to_clean(perfect, noisy, sigma), clean, atol=1e-4, rtol=1e-4)
    velocity = flow.to_velocity(perfect, noisy, sigma)
    torch.testing.assert_close(velocity, noise - clean, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_sampling_with_an_exact_denoiser_is_exact(prediction, steps):
    """The path is straight, so Euler steps along the true velocity end on the clean latent."""
    clean, noise = latents(0), latents(1)

    def exact(noisy, sigma):
        assert torch.all(sigma[:, 0] == 0)
        assert torch.equal(noisy[:, 0], clean[:, 0])
        return clean if prediction == "clean" else noise - clean

    out = FullSequence(prediction=prediction, shift=20).sample(exact, noise, clean[:, :1], steps)
    torch.testing.assert_close(out, clean, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("loss_on", ["velocity", "clean"])
@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_loss_of_a_zero_prediction_is_the_variance_of_its_target(prediction, loss_on):
    """Predicting 0 in the space of the loss leaves E|target|²: 1 for unit data, 2 for ε − x."""
    clean = latents(0, batch=512, frames=5)
    flow = FullSequence(prediction=prediction, loss_on=loss_on, weighting="none", shift=1)

    def zero_in_loss_space(noisy, sigma):
        level = sigma[:, :, None, None, None]
        if prediction == loss_on:
            return torch.zeros_like(noisy)
        return noisy if loss_on == "velocity" else noisy / level.clamp(min=1e-6)

    loss = flow.error(zero_in_loss_space, clean, [torch.Generator().manual_seed(3)] * 512)
    assert loss.item() == pytest.approx(2.0 if loss_on == "velocity" else 1.0, rel=0.05)


@pytest.mark.parametrize("known", [1, 2, 3])
def test_given_frames_are_clean_and_carry_no_loss(known):
    clean = latents(0)
    flow = FullSequence(prediction="clean", loss_on="clean")

    def wrong_in_what_is_given(noisy, sigma):
        assert torch.equal(noisy[:, :known], clean[:, :known])
        assert not sigma[:, :known].any()
        assert (sigma[:, known:] > 0).any()
        return torch.cat([clean[:, :known] + 100, clean[:, known:]], dim=1)

    generators = [torch.Generator().manual_seed(seed) for seed in range(3)]
    assert flow.error(wrong_in_what_is_given, clean, generators, known).item() == 0

    def wrong_after_it(noisy, sigma):
        return clean + 1

    assert flow.error(wrong_after_it, clean, generators, known).item() > 0


def test_same_generator_same_loss():
    clean = latents(0)
    flow = FullSequence(prediction="clean", loss_on="clean")
    losses = [
        flow.error(lambda noisy, _: noisy, clean, [torch.Generator().manual_seed(s)] * 3).item()
        for s in (5, 5, 6)
    ]
    assert losses[0] == losses[1] != losses[2]


def test_higher_shift_trains_on_more_noise():
    assert shifted_schedule(1000, 20).mean() > shifted_schedule(1000, 5).mean() > 0.5


@pytest.mark.parametrize("bad", [{"shift": 0.0}, {"steps": 0}])
def test_impossible_parameters_are_refused(bad):
    with pytest.raises(RecipeError, match=r"objective\."):
        FullSequence(**bad)
