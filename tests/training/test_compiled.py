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


def training(parts, **config):
    """A function that does a training step of a compiled model, by its number."""
    module = TrainingModule(
        build_world_model(recipe("", *parts), TinyWorld.card),
        TrainingConfig(compile=True, **config),
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
        module.training_step(batch, 0).backward()

    return step


@pytest.mark.parametrize("parts", combinations())
def test_a_model_is_compiled_once_and_in_one_piece(parts):
    """For all of 20 steps, whatever their noise; but shortcut forcing also evaluates some clips."""
    step = training(parts)
    for number in range(20):
        step(number)
    most = 3 if parts[2] == "shortcut" else 1  # one clip and several, without gradients
    assert 1 <= counters["stats"]["unique_graphs"] <= most
