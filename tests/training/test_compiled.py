"""Models as training compiles them: in one piece, and not again and again."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch._dynamo import config as dynamo
from torch._dynamo.utils import counters

from acwm_core.model.build import build_world_model
from acwm_core.training.config import TrainingConfig
from acwm_core.training.module import TrainingModule
from tests.tiny import TinyWorld
from tests.training.parts import combinations, recipe


@pytest.fixture(autouse=True)
def compiling(monkeypatch):
    """In one piece or not at all, and without the minutes that a fast program takes."""
    compiled = partial(torch.compile, fullgraph=True, backend="aot_eager")
    monkeypatch.setattr(torch, "compile", compiled)
    torch._dynamo.reset()
    counters.clear()
    with dynamo.patch(fail_on_recompile_limit_hit=True):
        yield
    torch._dynamo.reset()


def training(parts, *, compiled=True, **config):
    """A function that does a training step of a compiled model, by its number.

    It returns the loss and the gradients, which add up.
    """
    torch.manual_seed(0)
    module = TrainingModule(
        build_world_model(recipe("", *parts), TinyWorld.card),
        TrainingConfig(compile=compiled, **config),
    )
    module.configure_model()
    module.log = lambda *_, **__: None
    optimizer = SimpleNamespace(param_groups=[{"lr": 0.1}])
    codec = module.world_model.codec

    def step(number, frames=3):
        module._trainer = SimpleNamespace(
            global_step=number, max_steps=100, accumulate_grad_batches=1, optimizers=[optimizer]
        )
        batch = {
            "latents": torch.randn(2, frames, codec.channels, 4, 4),
            "actions": torch.rand(2, codec.video_frames(frames), 2),
            "positions": (2 * number, 2 * number + 1),
        }
        loss = module.training_step(batch, 0)
        loss.backward()
        return loss.item(), [p.grad for p in module.parameters() if p.grad is not None]

    return step


@pytest.mark.parametrize("parts", combinations())
@pytest.mark.ci
def test_a_model_is_compiled_once_and_in_one_piece(parts):
    """For all of 20 steps, whatever their noise; but shortcut forcing also evaluates some clips."""
    step = training(parts)
    for number in range(20):
        step(number)
    assert 1 <= counters["stats"]["unique_graphs"] <= most_graphs(parts)


def most_graphs(parts):
    return 3 if parts[2] == "shortcut" else 1  # one clip and several, without gradients


@pytest.mark.slow
@pytest.mark.parametrize("parts", combinations())
def test_what_inductor_makes_of_a_model_computes_the_same(parts, monkeypatch):
    """Losses and gradients of steps with other noise, without compiling again."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="inductor"))
    made = [step_by_step(training(parts, compiled=compiled)) for compiled in (True, False)]
    assert counters["inductor"]
    assert 1 <= counters["stats"]["unique_graphs"] <= most_graphs(parts)
    for (loss, gradients), (expected, expected_gradients) in zip(*made, strict=True):
        assert loss == pytest.approx(expected, rel=1e-4)
        torch.testing.assert_close(gradients, expected_gradients, rtol=1e-3, atol=1e-5)


def step_by_step(step, steps=5):
    made = []
    for number in range(steps):
        torch.manual_seed(number)
        loss, gradients = step(number)
        made.append((loss, [gradient.clone() for gradient in gradients]))
    return made
