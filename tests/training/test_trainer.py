"""From flags to a Trainer, and what the guard does where gradients may overflow."""

from pathlib import Path
from types import SimpleNamespace

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import RichProgressBar, Timer
from lightning.pytorch.strategies import DDPStrategy

from acwm_core.errors import RecipeError, TrainingError
from acwm_core.training.callbacks import LastCheckpoint, NanGuard
from acwm_core.training.config import TrainingConfig
from acwm_core.training.module import TrainingModule
from acwm_core.training.progress import StepProgress
from acwm_core.training.run_folder import RunFolder
from acwm_core.training.sharding import ShardedStrategy
from acwm_core.training.trainer import build_trainer, instantiate_flags
from tests.tiny import tiny_world_model


def build(ours=(), /, **flags) -> L.Trainer:
    flags = {"max_steps": 5, "accelerator": "cpu", **flags}
    return build_trainer(flags, TrainingConfig(), list(ours), [])


def test_objects_in_flags_are_made_and_typed():
    strategy = {
        "class_path": "lightning.pytorch.strategies.DDPStrategy",
        "init_args": {"find_unused_parameters": True},
    }
    timer = {
        "class_path": "lightning.pytorch.callbacks.Timer",
        "init_args": {"duration": "00:00:00:09"},
    }
    trainer = build(strategy=strategy, devices=2, callbacks=timer)  # need not be a list
    assert isinstance(trainer.strategy, DDPStrategy)
    assert trainer.world_size == 2
    assert any(isinstance(callback, Timer) for callback in trainer.callbacks)
    made = instantiate_flags({"strategy": strategy})
    assert made.keys() == {"strategy"}


def test_flags_go_over_our_defaults():
    assert build().log_every_n_steps == 10
    assert build(log_every_n_steps=3).log_every_n_steps == 3
    assert build().val_check_interval == 500
    assert build(accumulate_grad_batches=4).val_check_interval == 2000
    assert build(precision="64-true").precision == "64-true"


def test_ours_make_room_for_the_users():
    ours = [StepProgress(), LastCheckpoint(Path("last.ckpt"), 5)]
    bar = {"class_path": "lightning.pytorch.callbacks.RichProgressBar"}
    assert isinstance(build(ours, callbacks=[bar]).progress_bar_callback, RichProgressBar)
    assert build(ours, enable_progress_bar=False).progress_bar_callback is None


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"max_stesp": 1}, "max_stesp"),
        ({"max_steps": "many"}, "many"),
        ({"callbacks": [{"class_path": "lightning.Trainer"}]}, "Callback"),
        ({"callbacks": [{"class_path": "nowhere.Thing"}]}, "No module named 'nowhere'"),
        ({"devices": 0}, "devices"),
        ({"strategy": "dpp"}, "strategy='dpp'"),
        ({"gradient_clip_val": 1.0, "gradient_clip_algorithm": "nrom"}, "nrom"),
        (
            {"enable_checkpointing": False},
            "leaves no model: omit trainer.enable_checkpointing",
        ),
        ({"barebones": True}, "leaves no model"),
        ({"max_steps": 0}, "trains nothing"),
        ({"overfit_batches": 1}, "data.fraction"),
        ({"max_epochs": 3}, "set trainer.max_steps=… instead of trainer.max_epochs"),
        ({"max_steps": -1}, "the length of the training is missing"),
        ({"precision": "bf16-true"}, "use bf16-mixed"),
        ({"precision": "fp8"}, "trainer.precision: expected one of 'transformer-engine'"),
        ({"max_steps": 1e3}, "trainer.max_steps: Expected int. Got value: 1000.0"),
        ({"logger": ["csv", "wandbb"]}, "did you mean 'wandb'"),
        ({"logger": {"class_path": "lightning.pytorch.loggers.NoLogger"}}, "section trainer"),
    ],
)
def test_wrong_flags_are_one_sentence(flags, message):
    with pytest.raises((RecipeError, TrainingError)) as raised:
        build(**flags)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("config", [{"schedule": "linear"}, {"growing_horizon": 0.5}])
def test_a_share_of_the_steps_needs_their_number(config):
    flags = {"max_steps": -1, "max_time": "00:00:00:05", "accelerator": "cpu"}
    build_trainer(flags, TrainingConfig(), [], [])
    with pytest.raises(TrainingError, match=r"set trainer\.max_steps=…, or training\."):
        build_trainer(flags, TrainingConfig(**config), [], [])


@pytest.mark.parametrize(
    "strategy",
    [
        "deepspeed_stage_2",
        "fsdp_cpu_offload",
        {"class_path": "lightning.pytorch.strategies.ModelParallelStrategy"},
    ],
)
def test_other_sharding_is_refused(strategy):
    name = strategy if isinstance(strategy, str) else "ModelParallelStrategy"
    with pytest.raises(TrainingError, match=rf"{name} shards .*: use trainer\.strategy=fsdp"):
        build(strategy=strategy, devices=2)


def test_fsdp_is_a_word():
    assert isinstance(build(strategy="fsdp", devices=2).strategy, ShardedStrategy)
    assert isinstance(build(strategy="ddp", devices=2).strategy, DDPStrategy)


def test_a_recipe_for_gpus_on_a_machine_without_says_what_to_do(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(TrainingError, match=r"no GPU here.* use \+small"):
        build(accelerator="gpu", devices=8)


def test_with_a_gradient_scaler_only_the_loss_must_be_finite(tmp_path):
    """In 16-mixed the scaler skips steps whose gradients overflow; that is no reason to stop."""
    guard = NanGuard(RunFolder(tmp_path))
    module = TrainingModule(tiny_world_model(), TrainingConfig())
    weight = module.world_model.model.enter.weight
    weight.grad = torch.full_like(weight, float("inf"))
    module.log = lambda *_: None
    scaled, plain = (SimpleNamespace(scaler=s, global_step=4) for s in (object(), None))
    guard.on_before_optimizer_step(scaled, module, None)
    with pytest.raises(TrainingError):
        guard.on_before_optimizer_step(plain, module, None)
    guard.on_train_batch_end(scaled, module, {"loss": torch.tensor(1.0)}, None, 0)
    with pytest.raises(TrainingError, match="step 4"):
        guard.on_train_batch_end(scaled, module, {"loss": torch.tensor(float("nan"))}, None, 0)
