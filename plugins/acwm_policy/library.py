"""Learners of stable-baselines3: `sac`, `ppo` and `td3`."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
import stable_baselines3
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from acwm_core.errors import RecipeError
from acwm_core.recipe.signature import Parameter, signature
from acwm_policy.episodes import Episodes
from acwm_policy.learner import Learner, Report
from acwm_policy.lesson import Lesson

FRAMEWORK = (
    *("policy", "env", "seed", "device", "verbose", "_init_setup_model", "use_sde"),
    *("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage"),
    *("rollout_buffer_class", "rollout_buffer_kwargs", "sde_sample_freq", "use_sde_at_warmup"),
)
"""Parameters of the library's classes that are no settings here."""

TYPES: Mapping[str, Any] = {
    "action_noise": float | None,  # the standard deviation of noise on scaled actions
    "policy_kwargs": dict[str, Any] | None,
    "train_freq": int | list[int | str],
    "tensorboard_log": str | None,
    **dict.fromkeys(("ent_coef", "target_entropy"), float | str),
    **dict.fromkeys(("clip_range_vf", "target_kl"), float | None),
}
"""Types of parameters that their defaults do not tell."""

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
"""Counters of a learner that its state holds."""

BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of a replay buffer `[rows, scenes, …]`."""


class LibraryLearner(Learner):
    """A learner of stable-baselines3.

    Args:
        **parameters: those of its class.

    Attributes:
        algorithm: its class.
    """

    algorithm: ClassVar[Any]

    def __init__(self, **parameters: Any) -> None:
        kwargs = parameters.get("policy_kwargs") or {}
        if {*kwargs} - {"net_arch"}:
            raise RecipeError(
                "of policy_kwargs only net_arch can be set: policy_kwargs.net_arch=[64,64]"
            )
        self._parameters = parameters

    @classmethod
    def parameters(cls) -> Mapping[str, Parameter]:
        taken = signature(cls.algorithm).parameters
        return {
            name: Parameter(TYPES.get(name, type(parameter.default)), parameter.default)
            for name, parameter in taken.items()
            if name not in FRAMEWORK
        }

    @staticmethod
    def defaults(scenes: int) -> dict[str, Any]:
        """Parameters for so many scenes side by side, where those of the library are for one."""
        shared = {"gamma": 0.98, "buffer_size": 300_000, "gradient_steps": max(1, scenes // 8)}
        return shared | {"learning_starts": max(1000, 10 * scenes)}

    def begin(self, lesson: Lesson, seed: int) -> None:
        self._episodes = lesson.episodes
        parameters = {**self.defaults(self._episodes.number), **self._parameters}
        parameters = copy.deepcopy(parameters)  # the library adds to what it is given
        if (deviation := parameters.get("action_noise")) is not None:
            size = self._episodes.action_size
            parameters["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, deviation))
        if isinstance(parameters.get("train_freq"), list):
            parameters["train_freq"] = tuple(parameters["train_freq"])
        try:
            vector = VectorEpisodes(self._episodes)
            self._model = self.algorithm("MlpPolicy", vector, seed=seed, device="cpu", **parameters)
        except (ValueError, TypeError, AssertionError) as error:
            raise RecipeError(
                f"{self.algorithm.__name__} refuses its parameters: {str(error) or error!r}"
            ) from error

    def learn(self, steps: int, report: Report) -> None:
        self._model._last_obs = None  # so that the scenes begin anew
        left = steps - self._model.num_timesteps
        self._model.learn(left, callback=_Reporter(report), reset_num_timesteps=False)
        self.steps = self._model.num_timesteps

    def network(self) -> nn.Sequential:
        return network_in(self._model.policy)

    def state(self) -> dict[str, Any]:
        model = self._model
        names, variables = model._get_torch_save_params()
        kind, key, *rest = np.random.get_state()
        return {
            "weights": {name: _member(model, name).state_dict() for name in names},
            "variables": {name: _member(model, name).detach() for name in variables},
            "counters": {name: getattr(model, name) for name in COUNTERS},
            "buffer": _buffer_of(model),
            "torch": torch.get_rng_state(),
            "numpy": [kind, torch.from_numpy(np.asarray(key).astype(np.int64)), *rest],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        model = self._model
        for name, weights in state["weights"].items():
            _member(model, name).load_state_dict(weights)
        for name, value in state["variables"].items():
            _member(model, name).data = value.clone()
        for name, value in state["counters"].items():
            setattr(model, name, value)
        buffer = state["buffer"]
        if buffer:
            held, rows = model.replay_buffer, len(buffer["rewards"])
            for name in BUFFER:
                getattr(held, name)[:rows] = buffer[name].numpy()
            held.pos, held.full = buffer["pos"], buffer["full"]
        torch.set_rng_state(state["torch"])
        kind, key, *rest = state["numpy"]
        np.random.set_state((kind, key.numpy().astype(np.uint32), *rest))
        self.steps = model.num_timesteps

    def forget(self) -> None:
        if _buffer_of(self._model):
            self._model.replay_buffer.reset()


class SoftActorCritic(LibraryLearner):
    """Soft actor-critic (Haarnoja et al. 2018)."""

    algorithm = stable_baselines3.SAC

    @staticmethod
    def defaults(scenes: int) -> dict[str, Any]:
        # Rewards are about 1 in a whole episode, so exploration must not be worth more at first.
        return LibraryLearner.defaults(scenes) | {"ent_coef": "auto_0.1"}


class TwinDelayed(LibraryLearner):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018)."""

    algorithm = stable_baselines3.TD3

    @staticmethod
    def defaults(scenes: int) -> dict[str, Any]:
        return LibraryLearner.defaults(scenes) | {"action_noise": 0.1}


class ProximalPolicy(LibraryLearner):
    """Proximal policy optimisation (Schulman et al. 2017)."""

    algorithm = stable_baselines3.PPO

    @staticmethod
    def defaults(scenes: int) -> dict[str, Any]:
        rows = max(16, 4096 // scenes)
        return {"n_steps": rows, "batch_size": min(512, rows * scenes), "gamma": 0.98}


class VectorEpisodes(VecEnv):
    """Episodes as the library takes them.

    Args:
        episodes: the episodes.
    """

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        self._actions = torch.zeros(episodes.number, episodes.action_size)
        super().__init__(
            episodes.number,
            gymnasium.spaces.Box(-np.inf, np.inf, (episodes.observed,), np.float32),
            gymnasium.spaces.Box(-1.0, 1.0, (episodes.action_size,), np.float32),
        )

    def reset(self) -> NDArray[np.float32]:
        """Begin all scenes."""
        return self._episodes.begin().numpy()

    def step_async(self, actions: NDArray[np.floating[Any]]) -> None:
        """Take the scaled actions `[n, A]` of a step."""
        self._actions = torch.from_numpy(actions)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[Any]]:
        """Move all scenes; those that end begin again."""
        step = self._episodes.step(self._actions)
        over, infos = step.over.numpy(), [dict[str, Any]() for _ in range(self.num_envs)]
        for row in np.flatnonzero(over):
            infos[row] = {
                "terminal_observation": step.last[row].numpy(),
                "TimeLimit.truncated": bool(step.late[row]),
                "is_success": bool(step.solved[row]),
                "episode": {"r": float(step.returns[row]), "l": int(step.frames[row]), "t": 0.0},
            }
        return step.vectors.numpy(), step.rewards.numpy(), over, infos

    def close(self) -> None:
        """Free all resources."""
        self._episodes.close()

    # What stable-baselines3 asks of an environment in other processes ---------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute for each scene; `AttributeError` if there is no such one."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all scenes."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: Any, indices: Any = None, **named: Any
    ) -> list[Any]:
        """Call a method, and return its result for each scene."""
        result = getattr(self, method_name)(*arguments, **named)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Scenes are not wrapped."""
        return [False for _ in self._get_indices(indices)]


class _Reporter(BaseCallback):
    """Reports the steps of the library's learner."""

    def __init__(self, report: Report) -> None:
        super().__init__()
        self._report, self._reported = report, 0

    def _on_training_start(self) -> None:
        self._reported = self.num_timesteps = self.model.num_timesteps

    def _on_step(self) -> bool:
        self._report(self.num_timesteps - self._reported)
        self._reported = self.num_timesteps
        return True


def _buffer_of(model: Any) -> dict[str, Any]:
    """What a replay buffer holds; empty for a learner without one."""
    held = getattr(model, "replay_buffer", None)
    if held is None:
        return {}
    rows = held.buffer_size if held.full else held.pos
    arrays = {name: torch.from_numpy(getattr(held, name)[:rows].copy()) for name in BUFFER}
    return {**arrays, "pos": int(held.pos), "full": bool(held.full)}


def _member(model: Any, name: str) -> Any:
    for part in name.split("."):
        model = getattr(model, part)
    return model


def network_in(policy: Any) -> nn.Sequential:
    """The network of a policy of the library that acts without noise."""
    parts: Sequence[nn.Module]
    if hasattr(policy, "mlp_extractor"):
        parts = [policy.mlp_extractor.policy_net, policy.action_net, nn.Hardtanh()]
    elif hasattr(policy.actor, "latent_pi"):
        parts = [policy.actor.latent_pi, policy.actor.mu, nn.Tanh()]
    else:
        parts = [policy.actor.mu]
    return nn.Sequential(*(layer for part in parts for layer in _leaves(part)))


def _leaves(module: nn.Module) -> Iterator[nn.Module]:
    if isinstance(module, nn.Sequential):
        for part in module:
            yield from _leaves(part)
    elif not isinstance(module, nn.Identity | nn.Flatten):
        yield module
