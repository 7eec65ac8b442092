"""From an `EpisodeSpec` to an `Episode`: an environment's frames, states and actions."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionSpec, check_episode
from acwm_core.env.environment import Environment
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import PluginError, ShapeError, expect, noting
from acwm_core.plugins import Component, catalog


def make_environment(
    environment: str | Component, options: Mapping[str, Any] | None = None
) -> Environment:
    """Construct an environment from its registered name (or its catalog entry) and options.

    Args:
        environment: a registered name, or its `Component` in the catalog.
        options: constructor options, e.g. ``{"size": 64}``, as in `EpisodeSpec.options`.

    Raises:
        RecipeError: no environment has that name.
        PluginError: it cannot be constructed (e.g. it has no such option), is not an
            `Environment`, or its card has another name.
    """
    component = environment
    if isinstance(component, str):
        component = catalog().component("environment", component)
    instance = component.create_as(Environment, **(options or {}))
    if instance.card.name != component.name:
        raise PluginError(
            f"environment {component.name!r} has a card with the name {instance.card.name!r}: data "
            "carries the name of the card, so give the card the registered name"
        )
    return instance


def simulate(
    environment: Environment,
    spec: EpisodeSpec,
    actions: NDArray[np.floating[Any]] | None = None,
    *,
    frames: int | None = None,
    perturbation: float = 0.0,
    symmetry: Symmetry | None = None,
    start: int = 0,
) -> Episode:
    """Run one episode of T frames and record everything about it.

    Args:
        environment: the environment that `spec` names, constructed with the options of `spec`.
        spec: determines the start, the factors and the randomness of the behaviour policy.
        actions: raw actions ``[T, A]`` or ``[T − 1, A]`` to replay instead of the policy's; a
            T-th row leads to no frame and is not used.
        frames: T; by default and at most ``card.horizon``.
        perturbation: how far to perturb the start state; see `Environment._perturb`.
        symmetry: transforms the start state, but no actions; see `Environment._transform`.
        start: number of the perturbed start, of those that differ by as much.

    Raises:
        ShapeError: `actions` has neither T nor T − 1 rows.
        ShapeError: an action has the wrong shape, is out of its bounds or not finite.
        DataError: within the episode, the shapes of frames, masks or states, the state fields or
            the card change.
        PluginError: the environment raised something else.
        RecipeError: the spec asks for a factor or value that the environment does not have, or
            the environment has no perturbed or transformed start.
    """
    horizon = min(frames or environment.card.horizon, environment.card.horizon)
    if actions is not None and len(actions) not in (horizon, horizon - 1):
        raise ShapeError(
            f"{environment.card.name} replays {horizon} or {horizon - 1} actions, "
            f"not {len(actions)}"
        )
    options = {"spec": spec, "perturbation": perturbation, "symmetry": symmetry}
    options, card = {**options, "perturbed_start": start}, environment.card
    taken = np.zeros((horizon, card.action.size), np.float32)
    video: list[NDArray[Any]] = []
    infos: list[dict[str, Any]] = []

    def look(frame: NDArray[Any], info: Mapping[str, Any]) -> None:
        """Store copies: an environment may reuse its arrays from step to step."""
        video.append(np.array(frame))
        state = {name: np.array(value) for name, value in info["state"].items()}
        infos.append({**info, "state": state, "mask": np.array(info["mask"])})

    with noting(f"in episode {spec.index} of {spec.split} of {card.name}", environment):
        look(*environment.reset(options=options))
        act = environment.policy(spec.rng("policy")) if actions is None else iter(actions).__next__
        for index in range(horizon - 1):
            action = np.asarray(act(), np.float32)
            if action.shape != taken[index].shape:  # a scalar would be broadcast
                wanted = f"{card.name} takes actions of shape {taken[index].shape}"
                raise ShapeError(f"{wanted}, not {action.shape}")
            taken[index] = action
            frame, _, _, _, info = environment.step(action)
            look(frame, info)
        expect(environment.card == card, "the environment replaces its card within the episode")
        names = infos[0]["state"].keys()
        for info in infos:
            expect(info["state"].keys() == names, f"the state fields are {sorted(info['state'])}")
        contacts = [(index, *pair) for index, info in enumerate(infos) for pair in info["contacts"]]
        return Episode(
            spec=spec,
            video=_stacked("frames", video),
            actions=taken,
            states={n: _stacked(f"state {n}", [info["state"][n] for info in infos]) for n in names},
            masks=_stacked("masks", [info["mask"] for info in infos]),
            contacts=np.array(contacts, np.int32).reshape(-1, 3),
            factors=infos[0]["factors"],
            ood_label=infos[0]["ood_label"],
        )


def _stacked(what: str, values: Sequence[NDArray[Any]]) -> NDArray[Any]:
    shapes = dict.fromkeys(map(np.shape, values))
    expect(len(shapes) == 1, f"{what} change their shape: {' and '.join(map(str, shapes))}")
    return np.stack(values)


def simulated(
    component: Component,
    specs: Sequence[EpisodeSpec],
    exploration: float = 0.0,
    shift: float = 0.0,
) -> Iterator[Episode]:
    """Simulate the episodes `specs` of the environment `component`.

    A share `exploration` of the training episodes reuses the actions of the last episode before it
    that does not, which were chosen for another start; the first of `specs` never does. One
    dimension of them is shifted, by up to the share `shift` of half its range.

    Raises:
        DataError: an episode does not match the environment's card.
    """
    environment = _environment(component, specs[0].options)
    chosen: NDArray[np.floating[Any]] | None = None
    for spec in specs:
        explores = spec.split == "train" and spec.rng("exploration").random() < exploration
        reused = chosen if explores else None
        if reused is not None and shift:
            reused = _shifted(reused, environment.card.action, shift, spec.rng("shift"))
        episode = simulate(environment, spec, reused)
        with noting(f"in episode {spec.index} of {spec.split} of {environment.card.name}"):
            check_episode(episode, environment.card)
        yield episode
        chosen = episode.actions if reused is None else chosen


def _shifted(
    actions: NDArray[np.floating[Any]], spec: ActionSpec, shift: float, rng: np.random.Generator
) -> NDArray[np.floating[Any]]:
    """The actions with one dimension, drawn, moved by as much in all frames, within its bounds."""
    dimension = rng.integers(spec.size)
    low, high = spec.low[dimension], spec.high[dimension]
    shifted = actions.copy()
    shifted[:, dimension] += rng.uniform(-shift, shift) * (high - low) / 2
    shifted[:, dimension] = shifted[:, dimension].clip(low, high)
    return shifted


def _environment(component: Component, options: Mapping[str, Any]) -> Environment:
    """The environment of this process, cached: scenes and compiled kernels are costly to make."""
    key = json.dumps([component.target, dict(component.defaults), dict(options)], default=repr)
    if key not in _environments:
        for environment in _environments.values():
            environment.close()
        _environments.clear()
        _environments[key] = make_environment(component, options)
    return _environments[key]


_environments: dict[str, Environment] = {}
