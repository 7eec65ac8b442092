"""The moving average against its own recursion, written out independently."""

import pytest
import torch

from acwm_core.training.optimizers import averaged_copy, decay_at, update_average
from tests.training.tiny import tiny_world_model


def trainable(world_model):
    return {
        name: parameter.detach().double().clone()
        for name, parameter in world_model.named_parameters()
        if not name.startswith("codec.")
    }


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.999])
def test_average_follows_the_analytic_recursion(decay):
    """e₀ = w₀; eₙ = d·eₙ₋₁ + (1 − d)·wₙ, which for constant d is Σ d^(n−k)·(1 − d)·wₖ + dⁿ·w₀."""
    world_model = tiny_world_model()
    averaged = averaged_copy(world_model)
    history = [trainable(world_model)]
    for step in range(6):
        torch.manual_seed(step)
        with torch.no_grad():
            for parameter in (
                *world_model.model.parameters(),
                *world_model.conditioner.parameters(),
            ):
                parameter.add_(torch.randn_like(parameter))
        history.append(trainable(world_model))
        update_average(averaged, world_model, decay)
    steps = len(history) - 1
    for name, value in trainable(averaged).items():
        expected = decay**steps * history[0][name]
        for k in range(1, steps + 1):
            expected = expected + decay ** (steps - k) * (1 - decay) * history[k][name]
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6)


def test_copy_is_independent_frozen_and_shares_the_codec():
    world_model = tiny_world_model()
    averaged = averaged_copy(world_model)
    assert averaged.codec is world_model.codec
    assert not averaged.training
    assert world_model.model.training
    assert not any(parameter.requires_grad for parameter in averaged.parameters())
    assert all(parameter.requires_grad for parameter in world_model.model.parameters())
    before = trainable(averaged)
    with torch.no_grad():
        world_model.model.enter.weight.zero_()
    assert all(torch.equal(value, before[name]) for name, value in trainable(averaged).items())


def test_decay_ramps_up_to_its_limit():
    assert decay_at(1, 0.999) == pytest.approx(2 / 11)
    assert decay_at(8, 0.999) == pytest.approx(0.5)
    assert decay_at(10**6, 0.999) == 0.999
    assert decay_at(1, 0.0) == 0.0
