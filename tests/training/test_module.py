"""The training module in isolation: noise, gradients, parameter groups, batches of either kind."""

from types import SimpleNamespace

import lightning as L
import pytest
import torch
from torch.utils.data import DataLoader

from acwm_core.training.config import TrainingConfig
from acwm_core.training.module import COMPILED_LENGTHS, TrainingModule, generator_of, seed_of
from acwm_core.training.optimizers import parameter_groups
from tests.tiny import tiny_world_model


def test_noise_depends_on_every_part_of_its_key_and_on_nothing_else():
    keys = [(s, k, b, r) for s in (0, 1) for k in (0, 1) for b in (0, 1, 2**33) for r in (0, 1)]
    assert len({seed_of(*key) for key in keys}) == len(keys)
    draws = [torch.randn(8, generator=generator_of(3, 0, 5, 1)) for _ in range(2)]
    assert torch.equal(*draws)


def test_video_batches_are_latents_of_their_codec():
    module = TrainingModule(tiny_world_model(), TrainingConfig())
    video = torch.randint(0, 256, (2, 9, 3, 16, 16), dtype=torch.uint8)
    expected = module.world_model.codec.encode(video.float() / 255)
    assert torch.equal(module.latents({"video": video}), expected)
    assert torch.equal(module.latents({"latents": expected}), expected)


def parts_seen(steps, monkeypatch, **training):
    """First and last latent frame of 28 that reach the loss in some of 100 steps."""
    module = TrainingModule(tiny_world_model(), TrainingConfig(**training))
    codec = module.world_model.codec
    stride, seen = codec.temporal_stride, []
    monkeypatch.setattr(
        module.world_model,
        "loss",
        lambda *given: seen.append(given) or given[0].clone().requires_grad_(),
    )
    monkeypatch.setattr(module, "log", lambda *_, **__: None)
    optimizer = SimpleNamespace(param_groups=[{"lr": 0.1}])
    counted = torch.arange(28.0).reshape(1, 28, 1, 1, 1)
    rows = torch.arange(1.0 + 27 * stride)
    batch = {
        "latents": counted.expand(2, -1, codec.channels, 2, 2),
        "actions": rows[:, None].expand(2, -1, 2),
        "states": -rows[:, None].expand(2, -1, 3),
        "weights": rows.expand(2, -1),
        "positions": [0, 1],
    }
    for step in steps:
        module._trainer = SimpleNamespace(
            global_step=step, max_steps=100, accumulate_grad_batches=1, optimizers=[optimizer]
        )
        module.training_step(batch, 0)
    found = []
    for latents, actions, _, states, weights in seen:
        first, last = int(latents[0, 0].max()), int(latents[0, -1].max())
        assert actions[0, :, 0].tolist() == rows[first * stride : last * stride + 1].tolist()
        assert states[0, :, 0].tolist() == (-actions[0, :, 0]).tolist()
        assert torch.equal(weights, actions[..., 0])
        found.append((first, last))
    return found


def test_the_horizon_grows_to_the_whole_clip(monkeypatch):
    """In half of 100 steps from 4 predicted latent frames to all 27: 4 + ⌊23 · step / 50⌋."""
    lasts = {0: 4, 2: 4, 3: 5, 9: 8, 20: 13, 40: 22, 49: 26, 50: 27, 99: 27}
    seen = parts_seen(lasts, monkeypatch, growing_horizon=0.5)
    assert seen == [(0, last) for last in lasts.values()]


def test_clips_start_later_in_as_many_steps_as_asked(monkeypatch):
    seen = parts_seen(range(100), monkeypatch, random_starts=0.6)
    later = [first for first, _ in seen if first]
    assert 45 <= len(later) <= 75  # of a seeded draw
    assert set(later) <= set(range(1, 24))
    assert len(set(later)) > 15
    assert {last for _, last in seen} == {27}
    assert seen == parts_seen(range(100), monkeypatch, random_starts=0.6)
    both = parts_seen(range(50), monkeypatch, random_starts=0.6, growing_horizon=1.0)
    assert all(4 <= last - first <= 27 for first, last in both)


def test_compiled_models_see_few_lengths(monkeypatch):
    """Of 24 that a growing horizon and random starts give; the whole clip is among them."""
    seen = parts_seen(range(100), monkeypatch, growing_horizon=0.9, random_starts=0.3, compile=True)
    lengths = {last - first for first, last in seen}
    assert max(lengths) == 27
    assert min(lengths) == 4
    assert 5 <= len(lengths) <= COMPILED_LENGTHS + 1


class Recorder(L.Callback):
    """Keeps the weights before training and after every optimiser step."""

    def __init__(self) -> None:
        self.history = []

    def on_train_start(self, trainer, pl_module):
        self._keep(pl_module)

    def on_train_batch_end(self, trainer, pl_module, *_):
        if len(self.history) <= trainer.global_step:
            self._keep(pl_module)

    def _keep(self, module):
        self.history.append(
            {n: w.double().clone() for n, w in module.world_model.state_dict().items()}
        )


@pytest.mark.parametrize("accumulated", [1, 2])
def test_training_averages_once_per_optimiser_step(accumulated, tmp_path):
    """Against eₙ = dₙ·eₙ₋₁ + (1 − dₙ)·wₙ with dₙ = min(d, (1 + n)/(10 + n)), in float64."""
    module = TrainingModule(tiny_world_model(), TrainingConfig(learning_rate=1e-2, ema_decay=0.4))
    recorder = Recorder()
    trainer = L.Trainer(
        max_steps=5,
        accelerator="cpu",
        accumulate_grad_batches=accumulated,
        callbacks=[recorder],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    torch.manual_seed(0)
    batches = [
        {
            "latents": torch.randn(2, 5, 3, 2, 2),
            "actions": torch.rand(2, 9, 2),
            "positions": (2 * number, 2 * number + 1),
        }
        for number in range(10)
    ]
    trainer.fit(module, DataLoader(batches, batch_size=None))
    assert len(recorder.history) == 6
    expected = dict(recorder.history[0])
    for n, weights in enumerate(recorder.history[1:], start=1):
        decay = min(0.4, (1 + n) / (10 + n))
        expected = {k: decay * e + (1 - decay) * weights[k] for k, e in expected.items()}
    for name, value in module.averaged.state_dict().items():
        torch.testing.assert_close(value.double(), expected[name], rtol=1e-5, atol=1e-6)


def test_decay_spares_vectors_and_embeddings():
    world_model = tiny_world_model()
    names = {id(parameter): name for name, parameter in world_model.named_parameters()}
    decayed, free = parameter_groups(world_model, 0.1)
    assert {names[id(p)] for p in decayed["params"]} == {
        "model.enter.weight",
        "model.leave.weight",
        "conditioner.embed.weight",
    }
    assert {names[id(p)] for p in free["params"]} == {
        "model.enter.bias",
        "model.norm.weight",
        "model.norm.bias",
        "model.position.weight",
        "model.leave.bias",
        "conditioner.embed.bias",
    }
    assert (decayed["weight_decay"], free["weight_decay"]) == (0.1, 0.0)


def test_checkpoints_without_the_codec_load_and_others_do_not():
    module = TrainingModule(tiny_world_model(seed=1), TrainingConfig())
    checkpoint = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(checkpoint)
    other = TrainingModule(tiny_world_model(seed=2), TrainingConfig())
    other.load_state_dict(checkpoint["state_dict"])
    assert torch.equal(other.world_model.model.enter.weight, module.world_model.model.enter.weight)
    del checkpoint["state_dict"]["averaged.model.enter.weight"]
    with pytest.raises(RuntimeError, match=r"averaged\.model\.enter\.weight"):
        other.load_state_dict(checkpoint["state_dict"])
