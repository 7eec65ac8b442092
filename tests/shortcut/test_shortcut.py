"""Shortcut forcing against a target whose sampling steps are known in closed form.

Latents are N(m, s²) and independent, so the flow from noise takes a latent that is k standard
deviations from the mean at one noise level to k standard deviations at any other.
"""

import pytest
import torch
from torch import nn

from acwm_core.checks import check_model
from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Denoiser
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.recipe import compose
from acwm_dit.dit import DiT
from acwm_shortcut.shortcut import ShortcutForcing
from tests.checks.results import failures

MEAN, SPREAD = 0.7, 0.4


def per_frame(values):
    return values[:, :, None, None, None]


def draws(clips, seed=0):
    return [torch.Generator().manual_seed(seed + clip) for clip in range(clips)]


def clean(clips, frames=4, seed=1):
    drawn = torch.randn(clips, frames, 1, 2, 2, generator=torch.Generator().manual_seed(seed))
    return MEAN + SPREAD * drawn


class Exact(Denoiser):
    """Takes every step exactly; with a step of 0 it predicts the mean of what may be clean."""

    width, layers, heads, causal, inputs = 1, 0, 1, True, ShortcutForcing.inputs

    def __init__(self, shift):
        super().__init__()
        self.shift, self.steps = shift, []

    def forward(self, latents, sigma, conditioning, *, step):
        self.steps.append(step)
        place = sigma / (self.shift - (self.shift - 1) * sigma)
        later = (place - step).clamp(min=0)
        later = self.shift * later / (1 + (self.shift - 1) * later)
        now, then = (((1 - s) ** 2 * SPREAD**2 + s**2).sqrt() for s in (sigma, later))
        off = latents - per_frame((1 - sigma) * MEAN)
        ends = per_frame((1 - later) * MEAN) + per_frame(then / now) * off
        way = per_frame(sigma / (sigma - later).clamp(min=1e-4))
        guess = MEAN + per_frame((1 - sigma) * SPREAD**2 / now**2) * off
        return torch.where(per_frame(step) > 0, latents - way * (latents - ends), guess)


NOTHING = Conditioning(None, None, None)


@pytest.mark.parametrize("shift", [1.0, 20.0])
@pytest.mark.parametrize("steps", [1, 2, 4])
def test_exact_steps_sample_the_distribution_in_any_number(shift, steps):
    objective, model, given = ShortcutForcing(shift=shift), Exact(shift), clean(3)[:, :1]
    made = objective.predict(model, Batch(given, NOTHING, draws(3)), 4, steps)
    noise = torch.stack([torch.randn(4, 1, 2, 2, generator=g) for g in draws(3)])
    torch.testing.assert_close(made[:, 1:], (MEAN + SPREAD * noise)[:, 1:], atol=1e-3, rtol=0)
    assert len(model.steps) == steps
    for step in model.steps:
        assert torch.equal(step[:, 0], torch.zeros(3))
        torch.testing.assert_close(step[:, 1:], torch.full((3, 3), 1 / steps))


@pytest.mark.parametrize("shift", [1.0, 20.0])
def test_a_model_that_takes_steps_exactly_agrees_with_itself(shift):
    """Two exact half steps are an exact step, unless the halves are Euler steps of the flow."""
    objective, model = ShortcutForcing(shift=shift, finest=8), Exact(shift)
    for size in (1.0, 0.5, 0.25):
        step = torch.full((2, 4), size)
        place = torch.tensor([[1.0, size, 1.0, size], [1.0, 1.0, size, size]])
        noisy = torch.randn(2, 4, 1, 2, 2, generator=torch.Generator().manual_seed(3))
        wanted = model(noisy, objective.level(place), NOTHING, step=step)
        found = objective.target(model, NOTHING, noisy, place, step)
        torch.testing.assert_close(found, wanted, atol=2e-3, rtol=1e-3)
        assert all(torch.equal(each, step / 2) for each in model.steps[-2:])
    objective.target(model, NOTHING, noisy, place, torch.full((2, 4), 0.125))
    assert not any(each.any() for each in model.steps[-2:])


def test_places_are_multiples_of_their_steps():
    objective = ShortcutForcing(finest=16, bootstrapped=0.5)
    drawn = [objective.draw_steps(8, generator) for generator in draws(600)]
    place, step = (torch.stack(each) for each in zip(*drawn, strict=True))
    assert set(step.unique().tolist()) == {0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1}
    long = step > 0
    assert torch.equal(place[long] % step[long], torch.zeros(int(long.sum())))
    assert (place - step >= 0).all()
    assert (place <= 1).all()
    assert 250 < long.any(1).sum() < 350  # half of the clips, four standard deviations
    assert torch.histogram(place[~long], torch.linspace(0, 1, 5)).hist.min() > 500


class Affine(Denoiser):
    """Predicts a · x + b per latent, where a and b depend on noise level and step."""

    width, layers, heads, causal = 1, 0, 1, True

    def __init__(self, inputs):
        super().__init__()
        self.inputs = inputs
        self.net = nn.Sequential(nn.Linear(4, 64), nn.SiLU(), nn.Linear(64, 2))

    def forward(self, latents, sigma, conditioning, *, step=None):
        size = torch.zeros_like(sigma) if step is None else step
        gain, offset = self.net(torch.stack([sigma, sigma**2, size, size.sqrt()], -1)).unbind(-1)
        return per_frame(gain) * latents + per_frame(offset)


def trained(objective, steps=500):
    torch.manual_seed(0)
    model = Affine(objective.inputs)
    optimizer = torch.optim.Adam(model.parameters(), 1e-2)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1, 0, steps)
    for step in range(steps):
        latents, generators = clean(16, frames=33, seed=step), draws(16, seed=16 * step)
        loss = objective.loss(model, Batch(latents, NOTHING, generators), known=1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
    return model.requires_grad_(False)


@pytest.mark.ci
def test_after_training_one_step_samples_what_sixteen_of_the_flow_do():
    """In one step, flow matching alone ends at the mean, and its samples have no spread."""
    plain = DiffusionForcing(shift=1, prediction="clean", loss_on="clean", weighting="none")
    shortcut = ShortcutForcing(finest=8, bootstrapped=0.7, ramp=False)
    given, exact = clean(400, frames=1), Exact(1.0)
    flow = plain.sample(
        lambda noisy, sigma: exact(noisy, sigma, NOTHING, step=torch.zeros_like(sigma)),
        torch.randn(400, 5, 1, 2, 2, generator=torch.Generator().manual_seed(9)),
        given,
        steps=16,
    )[:, 1:]
    assert flow.std() > 0.75 * SPREAD
    for objective, steps, spread in ((plain, 1, 0.0), (shortcut, 1, flow.std().item())):
        model = trained(objective)
        made = objective.predict(model, Batch(given, NOTHING, draws(400)), 5, steps)[:, 1:]
        assert made.mean().item() == pytest.approx(MEAN, abs=0.06)
        assert made.std().item() == pytest.approx(spread, abs=0.03)


def test_the_dit_takes_the_step_and_streams_with_it():
    sizes = {"width": 32, "layers": 2, "heads": 2, "causal": True, "inputs": ShortcutForcing.inputs}
    assert failures(check_model(DiT, **sizes)) == {}


def test_the_overlay_lays_it_over_the_small_setting():
    recipe = compose("push_cube_small", ["+shortcut"])
    assert recipe.objective.name == "shortcut"
    assert recipe.objective.params["shift"] == 20.0


@pytest.mark.parametrize("bad", [{"finest": 12}, {"bootstrapped": 1.5}, {"steps": 0}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(RecipeError, match=rf"objective\.{next(iter(bad))}="):
        ShortcutForcing(**bad)
