"""Checks that an `EpisodeSpec` determines every byte of its episode."""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from acwm_core.checks.result import CheckFailure, expect
from acwm_core.checks.trial import BEGINNING, EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
from acwm_core.episode import Episode, EpisodeSpec


def same_spec_same_bytes(trial: EnvironmentTrial) -> None:
    """Give the same episode twice in a row."""
    again = trial.simulate(trial.spec(), frames=BEGINNING)
    _expect_same(trial.beginning, digests(again), "a second time")


def same_bytes_after_other_episodes(trial: EnvironmentTrial) -> None:
    """Keep nothing of earlier episodes: another instance, warmed up by others, agrees."""
    environment = trial.make(size=trial.size)
    others = [trial.spec("ood_test", index) for index in range(len(trial.card.ood_shifts))]
    for spec in (trial.spec("train", 1), *others):
        environment.reset(options={"spec": spec})
        for _ in range(3):
            environment.step(np.array(trial.card.action.high, np.float32))
    again = simulate(environment, trial.spec(), frames=BEGINNING)
    _expect_same(trial.beginning, digests(again), "after other episodes")


def same_bytes_in_a_fresh_process(trial: EnvironmentTrial) -> None:
    """Depend on nothing that this process happens to have done."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as pool:
        task = pool.submit(episode_digests, trial.make, trial.size, trial.spec())
        _expect_same(trial.episode, task.result(), "in a fresh process")


def replayed_actions_reproduce_the_episode(trial: EnvironmentTrial) -> None:
    """Depend on the policy through its actions alone."""
    actions = trial.beginning.actions
    again = trial.simulate(trial.spec(), actions, frames=len(actions))
    _expect_same(trial.beginning, digests(again), "when its recorded actions are replayed")


def episode_digests(
    make: Callable[..., Environment], size: tuple[int, int], spec: EpisodeSpec
) -> dict[str, str]:
    """Construct the environment, simulate and digest; runs in a fresh process too."""
    return digests(simulate(make(size=size), spec))


def digests(episode: Episode) -> dict[str, str]:
    """A hash of each array of an episode, by name, and of the rest as ``"factors"``."""
    arrays = {
        "actions": episode.actions,
        **{f"state {name!r}": values for name, values in episode.states.items()},
        "contacts": episode.contacts,
        "masks": episode.masks,
        "video": episode.video,
    }
    hashed = {name: _digest(values.tobytes()) for name, values in arrays.items()}
    return {"factors": _digest(repr((episode.factors, episode.ood_label)).encode()), **hashed}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _expect_same(episode: Episode, found: dict[str, str], when: str) -> None:
    expected = digests(episode)
    expect(expected.keys() == found.keys(), f"the state fields differ {when}")
    for name, digest in expected.items():
        if found[name] != digest:
            raise CheckFailure(f"the same spec gives other {name} {when}")


DETERMINISM = (
    same_spec_same_bytes,
    same_bytes_after_other_episodes,
    same_bytes_in_a_fresh_process,
    replayed_actions_reproduce_the_episode,
)
