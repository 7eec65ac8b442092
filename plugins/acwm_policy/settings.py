"""Settings of learning a policy, from overrides; a learner's parameters are those of its class."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from acwm_core.errors import MissingExtraError, RecipeError, suggest
from acwm_core.recipe.compose import parse_override
from acwm_core.recipe.signature import Parameter, signature
from acwm_core.recipe.types import checked

LIBRARY = "stable_baselines3"

ALGORITHMS = {"sac": "SAC", "ppo": "PPO", "td3": "TD3"}
"""Classes of the library, by the names under which they are chosen."""

FRAMEWORK = (
    *("policy", "env", "seed", "device", "verbose", "_init_setup_model", "use_sde"),
    *("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage"),
    *("rollout_buffer_class", "rollout_buffer_kwargs", "sde_sample_freq", "use_sde_at_warmup"),
)
"""Parameters of these classes that are no settings here."""

TYPES: Mapping[str, Any] = {
    "action_noise": float | None,  # the standard deviation of noise on scaled actions
    "policy_kwargs": dict[str, list[int] | dict[str, list[int]]] | None,
    "train_freq": int | list[int | str],
    "tensorboard_log": str | None,
    **dict.fromkeys(("ent_coef", "target_entropy"), float | str),
    **dict.fromkeys(("clip_range_vf", "target_kl"), float | None),
}
"""Types of parameters that their defaults do not tell."""


@dataclass(frozen=True)
class PolicySettings:
    """How a policy learns.

    Attributes:
        algorithm: one of `ALGORITHMS`.
        observe: names of the fields of the state to observe; by default those that are predicted
            and that an estimator reads.
        bonus: reward for success; the way from a usual start to the goal is worth 1.
        parameters: of the algorithm, those that were set.
    """

    algorithm: str = "sac"
    observe: list[str] | None = None
    bonus: float = 1.0
    parameters: dict[str, Any] = field(default_factory=dict[str, Any])


def algorithm_class(name: str) -> Any:
    """The library's class of an algorithm.

    Raises:
        RecipeError: there is no such algorithm.
        MissingExtraError: the library is not installed.
    """
    if name not in ALGORITHMS:
        known = ", ".join(ALGORITHMS)
        raise RecipeError(
            f"there is no algorithm {name!r}{suggest(name, ALGORITHMS)}; give {known}"
        )
    if importlib.util.find_spec(LIBRARY) is None:
        raise MissingExtraError(
            "training a policy needs stable-baselines3: pip install 'acwm[policies]'"
        )
    return getattr(importlib.import_module(LIBRARY), ALGORITHMS[name])


def parameters_of(name: str) -> dict[str, Parameter]:
    """The parameters of an algorithm that can be set, with their types and defaults."""
    taken = signature(algorithm_class(name)).parameters
    return {
        each: Parameter(TYPES.get(each, type(parameter.default)), parameter.default)
        for each, parameter in taken.items()
        if each not in FRAMEWORK
    }


def settings_of(overrides: Sequence[str]) -> PolicySettings:
    """Build the settings from overrides such as ``algorithm=ppo`` and ``learning_rate=1e-3``.

    Raises:
        RecipeError: a setting, or a parameter of the algorithm, does not exist or has a wrong
            value.
        MissingExtraError: the library is not installed.
    """
    given: dict[str, Any] = {}
    for override in overrides:
        for name, value in parse_override(override).items():
            given[name] = {**given.get(name, {}), **value} if isinstance(value, dict) else value
    own: dict[str, Any] = {
        "algorithm": checked("algorithm", given.pop("algorithm", "sac"), str),
        "observe": checked("observe", given.pop("observe", None), list[str] | None),
        "bonus": checked("bonus", given.pop("bonus", 1.0), float),
    }
    known, parameters = parameters_of(own["algorithm"]), dict[str, Any]()
    for name, value in given.items():
        if name not in known:
            near = suggest(name, [*own, *known])
            raise RecipeError(
                f"{own['algorithm']} has no parameter {name!r}{near}; it has {', '.join(known)}, "
                "and beside these you can set algorithm, observe and bonus"
            )
        parameters[name] = _checked(name, value, known[name].type)
    return PolicySettings(**own, parameters=parameters)


def _checked(name: str, value: Any, expected: Any) -> Any:
    if name == "policy_kwargs" and isinstance(value, dict) and {*value} - {"net_arch"}:
        raise RecipeError(
            "of policy_kwargs only net_arch can be set: policy_kwargs.net_arch=[64,64]"
        )
    return checked(name, value, expected)


def defaults_of(algorithm: str, scenes: int) -> dict[str, Any]:
    """Parameters for so many scenes side by side, where those of the library are for one."""
    if algorithm == "ppo":
        rows = max(16, 4096 // scenes)
        return {"n_steps": rows, "batch_size": min(512, rows * scenes), "gamma": 0.98}
    shared = {"gamma": 0.98, "buffer_size": 300_000, "gradient_steps": max(1, scenes // 8)}
    shared |= {"learning_starts": max(1000, 10 * scenes)}
    # Rewards are about 1 in a whole episode, so exploration must not be worth more at first.
    return shared | ({"action_noise": 0.1} if algorithm == "td3" else {"ent_coef": "auto_0.1"})
