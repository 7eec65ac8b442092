"""The learning rate's shape at its corners, and against PyTorch's own schedulers."""

from itertools import pairwise

import pytest
import torch
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR

from acwm_core.errors import TrainingError
from acwm_core.training.config import TrainingConfig
from acwm_core.training.optimizers import learning_rate_factor, require_length


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


def test_linear_decay_is_pytorchs():
    expected = torch_factors(LinearLR, start_factor=1.0, end_factor=0.0, total_iters=20)
    assert factors(20, schedule="linear") == pytest.approx(expected)


def test_cosine_decay_is_pytorchs():
    expected = torch_factors(CosineAnnealingLR, T_max=20)
    assert factors(20, schedule="cosine") == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_decay_starts_where_it_is_told_and_would_end_at_zero(schedule):
    config = TrainingConfig(schedule=schedule, decay_start=0.5, warmup_steps=2)
    curve = [learning_rate_factor(step, config, 10) for step in range(12)]
    assert curve[:6] == pytest.approx([0.5, 1, 1, 1, 1, 1])
    assert all(earlier > later > 0 for earlier, later in pairwise(curve[5:10]))
    assert curve[10:] == pytest.approx([0, 0])


def test_a_decay_needs_a_length():
    require_length(TrainingConfig(), -1)
    with pytest.raises(TrainingError, match=r"set trainer\.max_steps"):
        require_length(TrainingConfig(schedule="cosine"), -1)
