"""A learner of stable-baselines3: making it, saving it in full, and taking the policy out of it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from acwm_core.errors import DataError, RecipeError
from acwm_core.files import load_plain, written_whole
from acwm_planning.policies.saved import ACTIVATIONS
from acwm_policy.settings import PolicySettings, algorithm_class, defaults_of
from acwm_policy.vector import TaskScenes

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
"""Counters of a learner that its checkpoint holds."""

BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of a replay buffer `[rows, scenes, …]`."""


def make_learner(settings: PolicySettings, scenes: TaskScenes, seed: int) -> Any:
    """The learner that the settings ask for.

    Raises:
        RecipeError: the library refuses the parameters.
    """
    kind = algorithm_class(settings.algorithm)
    parameters = {**defaults_of(settings.algorithm, scenes.num_envs), **settings.parameters}
    parameters = copy.deepcopy(parameters)  # the library adds to what it is given
    if (deviation := parameters.get("action_noise")) is not None:
        size = scenes.action_space.shape
        assert size is not None
        noise = NormalActionNoise(np.zeros(size), np.full(size, deviation))
        parameters["action_noise"] = noise
    if isinstance(parameters.get("train_freq"), list):
        parameters["train_freq"] = tuple(parameters["train_freq"])
    try:
        return kind("MlpPolicy", scenes, seed=seed, device="cpu", **parameters)
    except (ValueError, TypeError, AssertionError) as error:
        raise RecipeError(
            f"{settings.algorithm} refuses its parameters: {str(error) or error!r}"
        ) from error


def save_checkpoint(path: Path, learner: Any, scenes: TaskScenes, **more: Any) -> None:
    """Write all that the learner needs to go on, and more plain values, to one file."""
    names, variables = learner._get_torch_save_params()
    python: Any = np.random.get_state()
    state = scenes.random.bit_generator.state
    whole = {
        "weights": {name: _member(learner, name).state_dict() for name in names},
        "variables": {name: _member(learner, name).detach() for name in variables},
        "counters": {name: getattr(learner, name) for name in COUNTERS},
        "buffer": _buffer_of(learner),
        "random": {
            "torch": torch.get_rng_state(),
            "numpy": [python[0], torch.from_numpy(python[1].astype(np.int64)), *python[2:]],
            "scenes": {name: str(value) for name, value in state["state"].items()},
        },
        **more,
    }
    with written_whole(path) as partial:
        torch.save(whole, partial)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint; nothing in it is run.

    Raises:
        DataError: it is damaged.
    """
    found: Any = load_plain(path)
    if not isinstance(found, dict) or not {"weights", "counters", "buffer"} <= {*found}:
        raise DataError(f"{path} is no checkpoint of a policy: delete it to begin anew")
    return found


def restore(learner: Any, scenes: TaskScenes, whole: Mapping[str, Any]) -> None:
    """Bring a learner to where a checkpoint was written; its scenes begin anew."""
    for name, weights in whole["weights"].items():
        _member(learner, name).load_state_dict(weights)
    for name, value in whole["variables"].items():
        _member(learner, name).data = value
    for name, value in whole["counters"].items():
        setattr(learner, name, value)
    buffer = whole["buffer"]
    if buffer:
        held, rows = learner.replay_buffer, len(buffer["rewards"])
        for name in BUFFER:
            getattr(held, name)[:rows] = buffer[name].numpy()
        held.pos, held.full = buffer["pos"], buffer["full"]
    random = whole["random"]
    torch.set_rng_state(random["torch"])
    kind, key, *rest = random["numpy"]
    np.random.set_state((kind, key.numpy().astype(np.uint32), *rest))
    state = scenes.random.bit_generator.state
    own = {name: int(value) for name, value in random["scenes"].items()}
    scenes.random.bit_generator.state = {**state, "state": own}


def _buffer_of(learner: Any) -> dict[str, Any]:
    """What a replay buffer holds; empty for a learner without one."""
    held = getattr(learner, "replay_buffer", None)
    if held is None:
        return {}
    rows = held.buffer_size if held.full else held.pos
    arrays = {name: torch.from_numpy(getattr(held, name)[:rows].copy()) for name in BUFFER}
    return {**arrays, "pos": int(held.pos), "full": bool(held.full)}


def _member(learner: Any, name: str) -> Any:
    for part in name.split("."):
        learner = getattr(learner, part)
    return learner


def network_in(learner: Any) -> tuple[list[int | str], nn.Sequential]:
    """The network that acts without noise, and its layers as a policy's file names them.

    Raises:
        RecipeError: it has layers that such a file cannot hold.
    """
    policy = learner.policy
    if hasattr(policy, "mlp_extractor"):
        parts = [policy.mlp_extractor.policy_net, policy.action_net, nn.Hardtanh()]
    elif hasattr(policy.actor, "latent_pi"):
        parts = [policy.actor.latent_pi, policy.actor.mu, nn.Tanh()]
    else:
        parts = [policy.actor.mu]
    names = {kind: name for name, kind in ACTIVATIONS.items()}
    layers, modules = list[int | str](), list[nn.Module]()
    for module in (layer for part in parts for layer in _leaves(part)):
        if isinstance(module, nn.Linear):
            copied = nn.Linear(module.in_features, module.out_features)
            copied.load_state_dict(module.state_dict())
            layers.append(module.out_features)
            modules.append(copied)
        elif type(module) in names:
            layers.append(names[type(module)])
            modules.append(type(module)())
        else:
            raise RecipeError(f"a policy with a layer {type(module).__name__} cannot be saved")
    return layers, nn.Sequential(*modules)


def _leaves(module: nn.Module) -> Iterator[nn.Module]:
    if isinstance(module, nn.Sequential):
        for each in module:
            yield from _leaves(each)
    elif not isinstance(module, nn.Identity | nn.Flatten):
        yield module
