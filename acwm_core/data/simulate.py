"""From an `EpisodeSpec` to an `Episode`: run an environment under its policy or given actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.catalog import catalog
from acwm_core.environment import Environment, Policy
from acwm_core.episode import Episode, EpisodeSpec
from acwm_core.errors import PluginError, RecipeError, ShapeError
from acwm_core.registry import Component


def make_environment(
    environment: str | Component, options: Mapping[str, Any] | None = None
) -> Environment:
    """Construct an environment from its registered name (or its catalog entry) and options.

    Args:
        environment: a registered name, or the `Component` that the catalog holds under it.
        options: constructor options, e.g. ``{"size": 64}``; `EpisodeSpec.options` has them.

    Raises:
        UnknownNameError: no environment has that name.
        RecipeError: the constructor has no such option.
        PluginError: the name stands for something that is no `Environment`.
    """
    component = environment
    if isinstance(component, str):
        component = catalog().component("environment", component)
    try:
        made = component.create(**(options or {}))
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        raise RecipeError(f"environment {component.name!r}: {error}") from error
    if not isinstance(made, Environment):
        raise PluginError(
            f"environment {component.name!r} ({component.target}) is no acwm Environment"
        )
    return made


def simulate(
    environment: Environment,
    spec: EpisodeSpec,
    actions: NDArray[np.floating[Any]] | None = None,
    *,
    frames: int | None = None,
    perturbation: float = 0.0,
) -> Episode:
    """Run one episode of T frames and record everything about it.

    Args:
        environment: an environment of the kind and with the options that `spec` names.
        spec: decides the start, the factors and the behaviour policy's randomness.
        actions: raw actions ``[T, A]`` or ``[T − 1, A]`` to replay instead of the policy's; a
            T-th row leads to no frame and is not used.
        frames: T, at most ``card.horizon``, which it is by default.
        perturbation: start slightly elsewhere, by so much; see `Environment._perturb`.

    Raises:
        ShapeError: `actions` has neither T nor T − 1 rows.
        ActionError: an action is out of its bounds or not finite.
        RecipeError: the spec asks for a factor or value that the environment does not have, or
            the environment has no perturbed start.
    """
    horizon = min(frames or environment.card.horizon, environment.card.horizon)
    if actions is not None and len(actions) not in (horizon, horizon - 1):
        raise ShapeError(
            f"{environment.card.name} replays {horizon} or {horizon - 1} actions, "
            f"not {len(actions)}"
        )
    options = {"spec": spec, "perturbation": perturbation}
    frame, first_info = environment.reset(options=options)
    act = _replay(actions) if actions is not None else environment.policy(spec.rng("policy"))
    taken = np.zeros((horizon, environment.card.action.size), np.float32)
    video, infos = [frame], [first_info]
    for index in range(horizon - 1):
        taken[index] = act()
        frame, _, _, _, info = environment.step(taken[index])
        video.append(frame)
        infos.append(info)
    return Episode(
        spec=spec,
        video=np.stack(video),
        actions=taken,
        states=_stack_states(infos),
        masks=np.stack([info["mask"] for info in infos]),
        contacts=_stack_contacts(infos),
        factors=first_info["factors"],
        ood_label=first_info["ood_label"],
    )


def _replay(actions: NDArray[np.floating[Any]]) -> Policy:
    rows = iter(actions)
    return lambda: next(rows)


def _stack_states(infos: list[dict[str, Any]]) -> dict[str, NDArray[Any]]:
    return {name: np.stack([info["state"][name] for info in infos]) for name in infos[0]["state"]}


def _stack_contacts(infos: list[dict[str, Any]]) -> NDArray[np.int32]:
    """Rows ``(frame, id, id)`` over all frames."""
    rows = [(frame, *pair) for frame, info in enumerate(infos) for pair in info["contacts"]]
    return np.array(rows, np.int32).reshape(-1, 3)
