"""One task in isolation: noise, gradients, parameter groups, batches of video and of latents."""

import pytest
import torch

from acwm_core.training.config import TrainingConfig
from acwm_core.training.task import WorldModelTask, generator_of, parameter_groups, seed_of
from tests.training.tiny import tiny_world_model


def test_noise_depends_on_every_part_of_its_key_and_on_nothing_else():
    keys = [(s, k, b, r) for s in (0, 1) for k in (0, 1) for b in (0, 1, 2**33) for r in (0, 1)]
    assert len({seed_of(*key) for key in keys}) == len(keys)
    draws = [torch.randn(8, generator=generator_of(3, 0, 5, 1)) for _ in range(2)]
    assert torch.equal(*draws)


def test_video_batches_are_latents_of_their_codec():
    task = WorldModelTask(tiny_world_model(), TrainingConfig())
    video = torch.randint(0, 256, (2, 9, 3, 16, 16), dtype=torch.uint8)
    expected = task.world_model.codec.encode(video.float() / 255)
    assert torch.equal(task.latents({"video": video}), expected)
    assert torch.equal(task.latents({"latents": expected}), expected)


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
    task = WorldModelTask(tiny_world_model(seed=1), TrainingConfig())
    checkpoint = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(checkpoint)
    other = WorldModelTask(tiny_world_model(seed=2), TrainingConfig())
    other.load_state_dict(checkpoint["state_dict"])
    assert torch.equal(other.world_model.model.enter.weight, task.world_model.model.enter.weight)
    del checkpoint["state_dict"]["averaged.model.enter.weight"]
    with pytest.raises(RuntimeError, match=r"averaged\.model\.enter\.weight"):
        other.load_state_dict(checkpoint["state_dict"])
