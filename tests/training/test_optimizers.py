"""The optimisers by name, and several as one."""

import copy

import pytest
import torch
from torch import nn
from torch.optim import SGD, AdamW, Muon

from acwm_core.training.config import TrainingConfig
from acwm_core.training.optimizers import (
    JoinedOptimizer,
    build_optimizer,
    hidden_matrices,
    parameter_groups,
)


class Network(nn.Module):
    """Layers of every kind: an embedding, blocks, vectors and an output."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.table = nn.Embedding(5, 4)
        self.blocks = nn.ModuleList(nn.Sequential(nn.Linear(4, 4), nn.Tanh()) for _ in range(2))
        self.out = nn.Linear(4, 1)

    def forward(self, index):
        value = self.table(index)
        for block in self.blocks:
            value = block(value)
        return self.out(value)


def train(network, optimizer, steps):
    losses = []
    for step in range(steps):

        def closure(step=step):
            optimizer.zero_grad()
            loss = (network(torch.arange(5)) - step % 3).square().mean()
            loss.backward()
            return loss

        losses.append(float(optimizer.step(closure)))
    return losses


def test_muon_takes_the_matrices_of_blocks_alone():
    network = Network()
    assert hidden_matrices(network) == [block[0].weight for block in network.blocks]
    optimizer = build_optimizer(network, TrainingConfig(optimizer="muon"), fused=False)
    taken = [p for group in optimizer.param_groups for p in group["params"]]
    assert len(taken) == len(set(taken)) == len([*network.parameters()])


def test_joined_optimizers_do_what_each_would_do_alone():
    """Against PyTorch's own two, stepped by hand on another copy."""
    one = Network()
    other = copy.deepcopy(one)
    config = TrainingConfig(optimizer="muon", learning_rate=0.01, weight_decay=0.1)
    joined = build_optimizer(one, config, fused=False)
    hidden = hidden_matrices(other)
    muon = Muon(hidden, lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    adamw = AdamW(parameter_groups(other, 0.1, without=hidden), lr=0.01)
    losses = train(one, joined, 6)
    for step in range(6):
        loss = (other(torch.arange(5)) - step % 3).square().mean()
        assert losses[step] == pytest.approx(float(loss), rel=1e-6)
        other.zero_grad()
        loss.backward()
        muon.step()
        adamw.step()
    for mine, theirs in zip(one.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_a_learning_rate_of_a_joined_group_reaches_its_part():
    network = Network()
    before = [p.clone() for p in network.parameters()]
    optimizer = build_optimizer(network, TrainingConfig(optimizer="muon"), fused=False)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    train(network, optimizer, 2)
    for now, then in zip(network.parameters(), before, strict=True):
        assert torch.equal(now, then)


def test_a_joined_optimizer_goes_on_from_its_state():
    config = TrainingConfig(optimizer="muon", learning_rate=0.01)
    whole = Network()
    train(whole, build_optimizer(whole, config, fused=False), 6)
    first = Network()
    optimizer = build_optimizer(first, config, fused=False)
    train(first, optimizer, 3)
    second = copy.deepcopy(first)
    resumed = build_optimizer(second, config, fused=False)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    train(second, resumed, 3)
    for one, other in zip(whole.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)


def test_parts_of_a_joined_optimizer_keep_their_own_settings():
    weights = [nn.Parameter(torch.ones(1)) for _ in range(2)]
    joined = JoinedOptimizer(SGD([weights[0]], lr=1.0), SGD([weights[1]], lr=0.5))
    for weight in weights:
        weight.grad = torch.ones(1)
    joined.step()
    assert [float(weight) for weight in weights] == [0.0, 0.5]
