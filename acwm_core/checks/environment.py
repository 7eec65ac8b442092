"""`check_environment`: what every dataset, model and metric relies on in an environment."""

from __future__ import annotations

import functools
import json
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from acwm_core.checks.determinism import DETERMINISM, digests
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment, EnvironmentCard
from acwm_core.episode import Factor, FactorValue

STILL_FRAMES = 6
"""Frames for which nothing is asked of a perturbed start."""

CLOSE = 0.01
"""Mean difference of two pictures, as a share of white, that counts as hardly seen."""


def check_environment(
    environment: str | Callable[..., Environment], **params: Any
) -> Iterator[CheckResult]:
    """Check an environment against the contract of `acwm_core.environment.Environment`.

    Episodes are simulated at a small frame size; a check in a fresh process imports the
    environment there, so it must be importable.

    Args:
        environment: a registered name, or the class.
        **params: further constructor parameters, `size` excepted.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    make = factory("environment", environment)
    return run_checks(CHECKS, EnvironmentTrial(functools.partial(make, **params), environment))


def simulates_an_episode(trial: EnvironmentTrial) -> None:
    """Construct the environment and run its policy through one episode."""
    expect_is_a(trial.environment, Environment)
    expect(len(trial.episode.video) == trial.card.horizon, "the episode is shorter than promised")


def gymnasium_api(trial: EnvironmentTrial) -> None:
    """Pass Gymnasium's own `check_env`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(trial.make(size=trial.size), skip_render_check=True)


def card_is_complete(trial: EnvironmentTrial) -> None:
    """Say everything a user needs to know on the card."""
    card = trial.card
    if isinstance(trial.subject, str):
        expect(card.name == trial.subject, f"its card calls it {card.name!r}")
    for attribute in ("name", "summary", "engine"):
        expect(getattr(card, attribute), f"the card's {attribute} is empty")
    expect(card.fps > 0, f"{card.fps} frames per second")
    expect(card.horizon >= 2, f"a horizon of {card.horizon} frames leaves no action to take")
    expect(card.action.size > 0, "the action has no dimension")
    bounds = np.array([card.action.low, card.action.high])
    expect(np.all(np.isfinite(bounds)), "action bounds must be finite: models normalise by them")
    expect(card.state, "the card lists no state field")
    expect(len(card.instances) >= 2, "the card names nothing but the background in `instances`")
    for names in (card.action.names, [f.name for f in card.factors], [s.name for s in card.state]):
        expect(len(set(names)) == len(names), f"a name comes twice in {', '.join(names)}")


def card_survives_json(trial: EnvironmentTrial) -> None:
    """Come back from JSON unchanged, for datasets keep the card in a file."""
    restored = EnvironmentCard.from_dict(json.loads(json.dumps(trial.card.to_dict())))
    expect(restored == trial.card, "the card changes on its way through JSON")


def factors_have_ranges(trial: EnvironmentTrial) -> None:
    """Declare factors whose nominal value is in distribution and whose OoD values are not."""
    card = trial.card
    expect(card.factors, "the card declares no factor of variation")
    for factor in card.factors:
        expect(factor.train and factor.ood, f"factor {factor.name!r} lacks a train or OoD range")
        inside = [factor.nominal, *factor.train]
        outside = list(factor.ood) if factor.kind == "discrete" else _middles(factor)
        for value, beyond in [(v, False) for v in inside] + [(v, True) for v in outside]:
            expect(
                (factor.severity(value) > 0) == beyond,
                f"{factor.name}={value} must lie {'outside' if beyond else 'inside'} training",
            )
    names = [factor.name for factor in card.factors]
    expect(card.ood_shifts, "ood_shifts is empty, so ood_test would be no different from training")
    for name in card.ood_shifts:
        expect(name in names, f"ood_shifts names {name!r}, which is no factor of the card")


def splits_are_labelled(trial: EnvironmentTrial) -> None:
    """Shift the factors of `ood_shifts` in turn in `ood_test`, and nothing in other splits."""
    for split in ("train", "ind_test"):
        for index in range(4):
            _, info = trial.environment.reset(options={"spec": trial.spec(split, index)})
            expect(info["ood_label"] is None, f"{split} has an episode labelled OoD")
    for index in range(2 * len(trial.card.ood_shifts)):
        _, info = trial.environment.reset(options={"spec": trial.spec("ood_test", index)})
        wanted = trial.card.ood_shifts[index % len(trial.card.ood_shifts)]
        label = info["ood_label"]
        expect(
            label is not None and wanted in [part.split("=")[0] for part in label.split("+")],
            f"episode {index} of ood_test is labelled {label!r}, not {wanted!r}",
        )


def state_matches_card(trial: EnvironmentTrial) -> None:
    """Return exactly the state fields of the card, in their shapes, as finite numbers."""
    fields = {field.name: field.shape for field in trial.card.state}
    states = trial.episode.states
    expect(
        set(states) == set(fields),
        f"the state has {', '.join(sorted(states))}; the card says {', '.join(sorted(fields))}",
    )
    for name, values in states.items():
        shape, declared = values.shape[1:], fields[name]
        expect(shape == declared, f"state {name!r} has shape {shape}, the card says {declared}")
        expect(values.dtype.kind in "fiub", f"state {name!r} is {values.dtype}, not numbers")
        expect(np.all(np.isfinite(values)), f"state {name!r} is not finite")


def masks_match_card(trial: EnvironmentTrial) -> None:
    """Show instances in the mask, all of them named on the card."""
    masks, names = trial.episode.masks, trial.card.instances
    expect(masks.dtype == np.uint8, f"masks are {masks.dtype}, not uint8")
    shape = (len(masks), *trial.environment.frame_size)
    expect(masks.shape == shape, f"masks are {masks.shape}, not {shape}")
    expect(masks.max() < len(names), f"mask id {masks.max()} has no name in `instances`")
    expect(masks.any(), "the mask shows nothing but background")


def contacts_match_card(trial: EnvironmentTrial) -> None:
    """Report contacts between two different instances of the card."""
    for _, first, second in trial.episode.contacts.tolist():
        expect(first != second, f"instance {first} is in contact with itself")
        known = range(len(trial.card.instances))
        expect(first in known and second in known, f"contact ({first}, {second}) names no instance")


def results_are_fresh(trial: EnvironmentTrial) -> None:
    """Hand out arrays that later steps leave alone."""
    environment, actions = trial.environment, trial.beginning.actions[:-1]
    frame, info = environment.reset(options={"spec": trial.spec()})
    kept = {"frame": frame, "mask": info["mask"], **info["state"]}
    copies = {name: np.array(value) for name, value in kept.items()}
    for action in actions:
        environment.step(action)
    for name, copy in copies.items():
        expect(np.array_equal(kept[name], copy), f"a later step overwrote {name!r} of the first")


def policy_moves_something(trial: EnvironmentTrial) -> None:
    """Collect data worth learning from: actions within bounds that vary, frames that change."""
    actions, action = trial.episode.actions[:-1], trial.card.action
    low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
    expect(np.all((actions >= low) & (actions <= high)), "the policy leaves the action bounds")
    expect(np.ptp(actions, axis=0).any(), "the policy repeats a single action")
    change = np.ptp(trial.episode.video.astype(np.int16), axis=0).max()
    expect(change > 16, "nothing visibly moves in an episode of the policy")


def actions_matter(trial: EnvironmentTrial) -> None:
    """Answer other actions from the same start with another video."""
    action, frames = trial.card.action, len(trial.beginning.video)
    other = np.random.default_rng(0).uniform(action.low, action.high, (frames, action.size))
    changed = trial.simulate(trial.spec(), other.astype(np.float32), frames)
    same = np.array_equal(changed.video, trial.beginning.video)
    expect(not same, "other actions lead to the very same video")


def still_action_is_possible(trial: EnvironmentTrial) -> None:
    """Name an action that asks for no motion, within the bounds."""
    action, spec = np.asarray(_still(trial)), trial.card.action
    expect(action.shape == (spec.size,), f"still_action() has shape {action.shape}")
    inside = np.all((action >= spec.low) & (action <= spec.high))
    expect(inside, "still_action() leaves the action bounds")


def perturbed_start_is_close(trial: EnvironmentTrial) -> None:
    """Start close to where it would, and at rest, when asked for a perturbed start.

    There is nothing to check of an environment that has none.
    """
    if not trial.environment.can_be_perturbed:
        return
    still = np.tile(_still(trial), (STILL_FRAMES, 1))
    usual, same, moved, again = (
        simulate(trial.environment, trial.spec(), still, frames=STILL_FRAMES, perturbation=amount)
        for amount in (0.0, 0.0, 1.0, 1.0)
    )
    expect(digests(same) == digests(usual), "a perturbation of 0 changes the episode")
    expect(digests(moved) == digests(again), "the same spec is not perturbed the same way twice")
    starts = ((usual.states[name][0], values[0]) for name, values in moved.states.items())
    differs = any(not np.array_equal(*pair) for pair in starts)
    expect(differs, "a perturbation changes nothing in the state of the first frame")
    apart = np.abs(moved.video.astype(float) - usual.video).mean((1, 2, 3)) / 255
    expect(apart[0] < CLOSE, f"a perturbed start is seen: it differs by {apart[0]:.1%} on average")
    expect(
        apart[-1] < 3 * apart[0] + CLOSE / 4,
        f"a perturbed start is not at rest: {STILL_FRAMES - 1} frames later, nothing having been "
        f"asked for, the picture differs by {apart[-1]:.2%}, by {apart[0]:.2%} at first",
    )


def _still(trial: EnvironmentTrial) -> NDArray[np.float32]:
    """The action that asks for no motion at the start of the trial's episode."""
    trial.environment.reset(options={"spec": trial.spec()})
    return trial.environment.still_action()


def factors_matter(trial: EnvironmentTrial) -> None:
    """Change the episode when a factor is shifted (one of four episodes is enough)."""
    for factor in trial.card.factors:
        expect(
            any(_shift_shows(trial, index, factor) for index in range(4)),
            f"shifting factor {factor.name!r} out of distribution changes no frame",
        )


def size_changes_only_resolution(trial: EnvironmentTrial) -> None:
    """Show the same world at twice the frame size, in the same framing."""
    height, width = trial.size
    large = trial.make(size=(2 * height, 2 * width))
    actions = trial.beginning.actions
    episode = simulate(large, trial.spec(), actions, frames=len(actions))
    shape = episode.video.shape[1:]
    expect(shape == (2 * height, 2 * width, 3), f"size={2 * height, 2 * width} gave {shape}")
    for name, values in trial.beginning.states.items():
        same = np.array_equal(values, episode.states[name], equal_nan=True)
        expect(same, f"state {name!r} depends on the frame size")
    halved = episode.video.reshape(-1, height, 2, width, 2, 3).mean((2, 4))
    error = np.abs(halved - trial.beginning.video).mean() / 255
    expect(error < 0.03, f"at twice the size the picture differs by {error:.0%} on average")


def _shift_shows(trial: EnvironmentTrial, index: int, factor: Factor) -> bool:
    """Whether an episode looks different when `factor` is shifted; stops where it first does."""
    usual = trial.training_episode(index).video
    spec, environment = trial.spec(index=index, factors={factor.name: "ood"}), trial.environment
    frame, _ = environment.reset(options={"spec": spec})
    act = environment.policy(spec.rng("policy"))
    for expected in usual[:-1]:
        if not np.array_equal(frame, expected):
            return True
        frame, *_ = environment.step(np.asarray(act(), np.float32))
    return not np.array_equal(frame, usual[-1])


def _middles(factor: Factor) -> list[FactorValue]:
    """The middle of each OoD interval."""
    return [(low + high) / 2 for low, high in factor.ood]


CHECKS = (
    simulates_an_episode,
    gymnasium_api,
    card_is_complete,
    card_survives_json,
    factors_have_ranges,
    splits_are_labelled,
    state_matches_card,
    masks_match_card,
    contacts_match_card,
    results_are_fresh,
    policy_moves_something,
    actions_matter,
    still_action_is_possible,
    perturbed_start_is_close,
    factors_matter,
    size_changes_only_resolution,
    *DETERMINISM,
)
