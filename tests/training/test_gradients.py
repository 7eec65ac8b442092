"""Clipping against PyTorch's own, and through the trainer's flags."""

import pytest
import torch
from torch import nn

from acwm_core.errors import RecipeError
from acwm_core.training.config import TrainingConfig
from acwm_core.training.launch import fit
from acwm_core.training.optimizers import clip_norm, clip_values, gradient_norm
from acwm_core.training.run import RunFolder
from acwm_core.training.task import WorldModelTask
from tests.training.test_fit import numbers
from tests.training.tiny import tiny_recipe, tiny_world_model


def with_gradients(scale):
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(5, 7), nn.Linear(7, 3))
    module[1].bias.requires_grad_(False)  # has no gradient
    (module(torch.randn(4, 5)).square().mean() * scale).backward()
    return module


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_clipping_is_pytorchs(scale):
    ours, theirs = with_gradients(scale), with_gradients(scale)
    norm = gradient_norm(ours.parameters())
    assert torch.equal(norm, nn.utils.clip_grad_norm_(theirs.parameters(), 0.5))
    clip_norm(ours.parameters(), norm, 0.5)
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert one.grad is None or torch.equal(one.grad, other.grad)
    clip_values(ours.parameters(), 0.01)
    nn.utils.clip_grad_value_(theirs.parameters(), 0.01)
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert one.grad is None or torch.equal(one.grad, other.grad)


@pytest.mark.parametrize("algorithm", ["norm", "value"])
def test_the_flags_choose_the_clipping(algorithm):
    task = WorldModelTask(tiny_world_model(), TrainingConfig())
    weight = task.world_model.model.enter.weight
    weight.grad = torch.full_like(weight, 3.0)
    task.configure_gradient_clipping(torch.optim.SGD([weight], 1.0), 0.5, algorithm)
    clipped = weight.grad.norm() if algorithm == "norm" else weight.grad.max()
    torch.testing.assert_close(clipped, torch.tensor(0.5), rtol=1e-5, atol=0)
    task.configure_gradient_clipping(torch.optim.SGD([weight], 1.0), None, None)
    assert weight.grad.max() > 0


def test_mixed_precision_clips_with_a_fused_optimiser(data, tmp_path):
    """Lightning refuses the two together; plain gradient descent shows what was clipped."""
    flags = {"precision": "bf16-mixed", "gradient_clip_val": 1e-3, "max_steps": 2}
    run = RunFolder(fit(tiny_recipe(data, trainer=flags), tmp_path / "run"))
    groups = torch.load(run.last_checkpoint)["optimizer_states"][0]["param_groups"]
    assert all(group["fused"] for group in groups)
    assert float(numbers(run)["0", "train/gradient_norm"]) > 1e-2  # before clipping
    wrong = tiny_recipe(data, trainer={**flags, "gradient_clip_algorithm": "nrom"})
    with pytest.raises(RecipeError, match="nrom"):
        fit(wrong, tmp_path / "wrong")
