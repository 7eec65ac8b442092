"""What moves the weights, against PyTorch's own and analytic recursions."""

import copy
from itertools import pairwise

import pytest
import torch
from torch import nn
from torch.optim import SGD, AdamW, Muon
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR

from acwm_core.training.config import TrainingConfig
from acwm_core.training.fit import fit
from acwm_core.training.module import TrainingModule
from acwm_core.training.muon import Float32Muon
from acwm_core.training.optimizers import (
    JoinedOptimizer,
    averaged_copy,
    build_optimizer,
    decay_at,
    hidden_matrices,
    learning_rate_factor,
    parameter_groups,
)
from acwm_core.training.precision import updates_in_bfloat16
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe, tiny_world_model
from tests.training.runs import numbers


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


@pytest.mark.parametrize("adjusted", ["match_rms_adamw", "original", None])
def test_muon_in_float32_does_what_pytorchs_does_but_for_the_rounding(adjusted, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "bfloat16", torch.Tensor.float)
    torch.manual_seed(0)
    shapes = ((4, 12), (12, 4), (6, 6))
    mine, theirs = ([torch.nn.Parameter(torch.randn(shape)) for shape in shapes] for _ in range(2))
    for one, other in zip(mine, theirs, strict=True):
        other.data.copy_(one)
    settings = {"lr": 0.02, "weight_decay": 0.1, "adjust_lr_fn": adjusted}
    optimizers = Float32Muon(mine, **settings), Muon(theirs, **settings)
    for _ in range(3):
        gradients = [torch.randn(shape) for shape in shapes]
        for weights, optimizer in zip((mine, theirs), optimizers, strict=True):
            for each, gradient in zip(weights, gradients, strict=True):
                each.grad = gradient.clone()
            optimizer.step()
    for one, other in zip(mine, theirs, strict=True):
        torch.testing.assert_close(one, other)
    optimizers[0].load_state_dict(optimizers[1].state_dict())  # either goes on with the other's


@pytest.mark.parametrize(
    ("precision", "device", "has_bfloat16", "expected"),
    [
        ("bf16-mixed", "cpu", False, True),
        ("32-true", "cpu", True, False),
        ("64-true", "cpu", True, False),
        ("32-true", "cuda", True, True),
        ("16-mixed", "cuda", False, False),
        ("32-true", "mps", False, True),
    ],
)
def test_muon_computes_in_bfloat16_where_that_is_fast(
    precision, device, has_bfloat16, expected, monkeypatch
):
    monkeypatch.setattr("acwm_core.training.precision.gpu_has_bfloat16", lambda: has_bfloat16)
    assert updates_in_bfloat16(precision, torch.device(device)) == expected


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


def factors(max_steps, **config):
    made = TrainingConfig(**config)
    return [learning_rate_factor(step, made, max_steps) for step in range(max_steps)]


def torch_factors(schedule, **arguments):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = schedule(optimizer, **arguments)
    values = []
    for _ in range(20):
        values.append(scheduler.get_last_lr()[0])
        optimizer.step()
        scheduler.step()
    return values


def test_warmup_rises_to_one_and_constant_stays():
    assert factors(6, warmup_steps=4) == pytest.approx([0.25, 0.5, 0.75, 1, 1, 1])
    assert factors(3) == [1, 1, 1]


@pytest.mark.parametrize(
    ("name", "schedule", "arguments"),
    [
        ("linear", LinearLR, {"start_factor": 1.0, "end_factor": 0.0, "total_iters": 20}),
        ("cosine", CosineAnnealingLR, {"T_max": 20}),
    ],
)
def test_decay_is_pytorchs(name, schedule, arguments):
    expected = torch_factors(schedule, **arguments)
    assert factors(20, schedule=name) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_decay_starts_where_it_is_told_and_would_end_at_zero(schedule):
    config = TrainingConfig(schedule=schedule, decay_start=0.5, warmup_steps=2)
    curve = [learning_rate_factor(step, config, 10) for step in range(12)]
    assert curve[:6] == pytest.approx([0.5, 1, 1, 1, 1, 1])
    assert all(earlier > later > 0 for earlier, later in pairwise(curve[5:10]))
    assert curve[10:] == pytest.approx([0, 0])


@pytest.mark.parametrize("algorithm", ["norm", "value"])
def test_the_flags_choose_the_clipping(algorithm):
    task = TrainingModule(tiny_world_model(), TrainingConfig())
    weight = task.world_model.model.enter.weight
    weight.grad = torch.full_like(weight, 3.0)
    task.gradient_norm = weight.grad.norm()  # as the guard measures it
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


def trainable(world_model):
    return {
        name: parameter.detach().double().clone()
        for name, parameter in world_model.named_parameters()
        if not name.startswith("codec.")
    }


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
