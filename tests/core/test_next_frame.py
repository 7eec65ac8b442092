"""`objective=next_frame`: one pass over a clip is what sampling frame by frame does."""

import pytest
import torch
from torch import nn

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.build import build_model
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, Denoiser, ModelInputs
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.next_frame import NextFrame, frames_before
from acwm_core.recipe import ComponentConfig
from acwm_dit.dit import DiT

DECAY = 0.8
FLOW = {
    "prediction": "clean",
    "loss_on": "clean",
    "weighting": "none",
    "steps": 1,
}


class NoLayers(nn.Module):
    def inject_input(self, tokens, conditioning):
        return tokens

    def inject(self, layer, tokens, conditioning):
        return tokens


def draws(clips, seed=0):
    return [torch.Generator().manual_seed(seed + clip) for clip in range(clips)]


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def next_frame(**params):
    return NextFrame(**{**FLOW, **params})


def dit():
    torch.manual_seed(0)
    sizes = {"latent_channels": 4, "width": 32, "layers": 2, "heads": 2}
    model = DiT(**sizes, causal=True, inputs=NextFrame.inputs)
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.15)
    return model.eval()


def conditioning(clips=2, frames=6):
    return Conditioning(normal(clips, frames, 32, seed=5), None, NoLayers())


class NoCache(Cache):
    def keep(self, frames):
        self.frames += frames


class Scaled(Denoiser):
    """Predicts that a frame is `factor` times the one before, and keeps what it was shown."""

    width, layers, heads, causal, inputs = 1, 0, 1, True, NextFrame.inputs

    def __init__(self, factor=1.0):
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))
        self.shown = []

    def forward(self, latents, sigma, conditioning, *, previous, previous_sigma):
        self.shown.append(previous)
        return (self.factor - 1) * previous

    def new_cache(self, context):
        return NoCache(context)

    def extend(self, latents, sigma, conditioning, cache, *, previous, previous_sigma):
        return (self.factor - 1) * previous


def decaying(clips, frames=5):
    """A stationary process of variance 1: z' = DECAY · z + √(1 − DECAY²) · noise."""
    fresh = normal(frames, clips, 2, 4, 4, seed=3)
    latents = [fresh[0]]
    for each in fresh[1:]:
        latents.append(DECAY * latents[-1] + (1 - DECAY**2) ** 0.5 * each)
    return torch.stack(latents, 1)


@pytest.mark.parametrize("noise", [0.0, 0.6])
def test_the_loss_is_least_at_the_best_guess_from_the_noised_frame_before(noise):
    """E[z'·p] / E[p²] of p = (1 − σ) z + σ ε with σ uniform in [0, noise]."""
    model, objective, clips = Scaled(), next_frame(past_noise=noise), 3000
    latents, actions = decaying(clips), conditioning(clips, 5)
    signal = 1 - noise / 2
    power = 1 - noise + 2 * noise**2 / 3
    best = DECAY * signal / power
    slopes = []
    for factor in (best, best - 0.1, best + 0.1):
        model.factor.data.fill_(factor)
        loss = objective.loss(model, Batch(latents, actions, draws(clips)), 1)
        slopes.append(torch.autograd.grad(loss, model.factor)[0].item())
    assert abs(slopes[0]) < 0.015
    assert slopes[1] < -0.1
    assert slopes[2] > 0.1


@pytest.mark.parametrize("known", [1, 3])
def test_one_pass_over_a_clip_equals_sampling_it_frame_by_frame(known):
    model, given = dit(), normal(2, known, 4, 8, 8, seed=1)
    with torch.no_grad():
        clip = next_frame().predict(model, Batch(given, conditioning(), draws(2)), 6)
        generators = draws(2)
        later = [
            torch.stack([torch.randn(4, 8, 8, generator=g) for g in generators])
            for _ in range(known, 6)
        ]
        noisy = torch.cat([given, torch.stack(later, 1)], 1)
        sigma = torch.ones(2, 6)
        sigma[:, :known] = 0
        past = {"previous": frames_before(clip), "previous_sigma": torch.zeros(2, 6)}
        whole = frames_before(clip) + model(noisy, sigma, conditioning(), **past)
    torch.testing.assert_close(clip[:, :known], given)
    torch.testing.assert_close(clip[:, known:], whole[:, known:], rtol=0, atol=1e-5)
    assert (clip[:, known:] - clip[:, known - 1 : known]).abs().mean() > 0.1


def test_nothing_of_a_frame_itself_is_seen():
    """At noise level 1 a frame's prediction depends on frames before it alone."""
    model, objective, seen = dit(), next_frame(past_noise=0.0, shift=1e9), []
    latents = normal(2, 6, 4, 8, 8, seed=1)
    objective.error = lambda evaluate, clean, *_: seen.append(
        evaluate(normal(2, 6, 4, 8, 8, seed=2), torch.ones(2, 6))
    )
    changed = latents.clone()
    changed[:, 3:] += 1
    with torch.no_grad():
        for clip in (latents, changed):
            objective.loss(model, Batch(clip, conditioning(), draws(2)), 1)
    first, second = seen
    torch.testing.assert_close(first[:, :4], second[:, :4])
    assert (first[:, 4:] - second[:, 4:]).abs().mean() > 0.1


def test_own_past_shows_its_rollout_to_that_share_of_the_clips():
    model, clips = Scaled(0.5), 400
    latents, objective = decaying(clips), next_frame(past_noise=0.0, own_past=0.25)
    objective.loss(model, Batch(latents, conditioning(clips, 5), draws(clips)), 1)
    (told,) = model.shown
    rollout = latents[:, :1] * 0.5 ** torch.arange(5)[:, None, None, None]
    own = (told - frames_before(rollout)).abs().amax((1, 2, 3, 4)) < 1e-5
    true = (told - frames_before(latents)).abs().amax((1, 2, 3, 4)) < 1e-5
    assert torch.all(own ^ true)
    assert 70 < own.sum() < 130  # three and a half standard deviations about 100


def test_a_clip_draws_the_same_beside_any_others():
    model, objective, latents = Scaled(), next_frame(own_past=0.5), decaying(3)
    objective.loss(model, Batch(latents, conditioning(3, 5), draws(3)), 1)
    objective.loss(model, Batch(latents[1:], conditioning(2, 5), draws(2, seed=1)), 1)
    both, alone = model.shown
    assert torch.equal(both[1:], alone)


def test_a_recipe_sets_what_the_objective_needs():
    choice = ComponentConfig("dit_xs", {"causal": None, "inputs": None})
    inputs = ModelInputs(latent_channels=4, temporal_stride=4)
    model = build_model(choice, next_frame(), inputs)
    assert (model.causal, model.inputs) == (True, NextFrame.inputs)
    model = build_model(choice, DiffusionForcing(), inputs)
    assert (model.causal, model.inputs) == (True, {})


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"past_noise": 1.5}, r"past_noise=1.5 must be between 0 and 1"),
        ({"own_past": float("nan")}, r"own_past=nan must be"),
    ],
)
def test_values_out_of_range_are_refused(params, message):
    with pytest.raises(RecipeError, match=message):
        NextFrame(**params)
