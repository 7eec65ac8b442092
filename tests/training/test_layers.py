"""Layers that are computed again for their gradient, or compiled: the same training."""

import pytest
import torch
from torch import nn

from acwm_core.errors import TrainingError
from acwm_core.training.fit import fit
from acwm_core.training.layers import layers_of, recompute_activations
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.runs import weights

DEEP = {"model": {"depth": 2}, "trainer": {"max_steps": 6, "precision": "32-true"}}


class Layer(nn.Module):
    """Dropout between two matrices; counts what it computes."""

    def __init__(self):
        super().__init__()
        self.enter, self.leave = nn.Linear(4, 64), nn.Linear(64, 4)
        self.calls = 0

    def forward(self, x, scale):
        self.calls += 1
        return x + scale * self.leave(nn.functional.dropout(self.enter(x).tanh(), 0.5))


class Nested(nn.Module):
    def __init__(self):
        super().__init__()
        self.first = nn.Linear(4, 4)
        self.body = nn.Sequential()
        self.body.blocks = nn.ModuleList(Layer() for _ in range(3))
        self.more = nn.ModuleList([nn.ModuleList([nn.Linear(4, 4)])])

    def forward(self, x):
        x = self.first(x)
        for block in self.body.blocks:
            x = block(x, 0.7)
        return x.square().mean()


def kept_bytes(module, x):
    """Loss, gradients, and the bytes that the forward pass keeps for the backward pass."""
    kept = {}
    keep = lambda tensor: kept.setdefault(tensor.data_ptr(), tensor)  # noqa: E731
    torch.manual_seed(1)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss = module(x)
    loss.backward()
    gradients = {n: p.grad for n, p in module.named_parameters() if p.grad is not None}
    return loss, gradients, sum(t.nbytes for t in kept.values())


def test_recomputed_layers_give_the_same_and_keep_less():
    torch.manual_seed(0)
    plain, recomputed = Nested(), Nested()
    recomputed.load_state_dict(plain.state_dict())
    layers = list(layers_of(recomputed))
    assert layers[:3] == list(recomputed.body.blocks)
    recompute_activations(layers[:3])
    assert recomputed.state_dict().keys() == plain.state_dict().keys()
    x = torch.randn(100, 4)
    loss, gradients, kept = kept_bytes(plain, x)
    same, again, less = kept_bytes(recomputed, x)
    assert torch.equal(loss, same)
    assert all(torch.equal(value, again[name]) for name, value in gradients.items())
    assert [layer.calls for layer in layers[:3]] == [2, 2, 2]
    assert less < kept / 3


def test_a_model_without_layers_has_nothing_to_recompute(data, tmp_path):
    recipe = tiny_recipe(data, training={"activation_checkpointing": True})
    with pytest.raises(TrainingError, match=r"needs layers in an nn\.ModuleList"):
        fit(recipe, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("recomputes", [False, True])
def test_compiled_layers_train_alike(recomputes, data, tmp_path):
    words = {**DEEP, "model": {"depth": 2, "dropout": 0.0}}  # compiled, it draws other numbers
    whole = RunFolder(fit(tiny_recipe(data, **words), tmp_path / "whole"))
    words |= {"training": {"activation_checkpointing": recomputes, "compile": True}}
    run = RunFolder(fit(tiny_recipe(data, **words), tmp_path / "run"))
    torch.testing.assert_close(weights(whole), weights(run), rtol=1e-3, atol=1e-4)
