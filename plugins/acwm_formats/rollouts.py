"""Rollouts in Gymnasium environments as recordings: rendered frames while a policy acts."""

from __future__ import annotations

import functools
import importlib
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import VectorEnv

from acwm_core.env.card import plain_rate
from acwm_core.env.episode import EpisodeSpec, Split
from acwm_core.errors import DataError, RecipeError
from acwm_formats.format import Format
from acwm_formats.playing import Env, Policy, Several, Single, Stage, Take, Vector, play
from acwm_formats.timeline import ActionFacts, RecordedDataset, Recording

RANDOM = "random"
FPS = 10  # for environments without `render_fps`
LAST = (
    "The vector environment shows the next episode in the step that ends one (SAME_STEP), so the "
    "last frame and action of episodes that end by themselves are left out."
)


class Named(NamedTuple):
    """How to make an environment: its id, or ``module:function``; and how many to step at once."""

    env_id: str
    envs: int | None = None


class Gymnasium(Format):
    """Rollouts in a Gymnasium environment, simulated when they are read."""

    def read(
        self,
        env_id: str,
        *,
        episodes: tuple[int, ...],
        policy: str = RANDOM,
        seed: int = 0,
        frames: int = 1000,
        envs: int | None = None,
    ) -> RecordedDataset:
        """Import rollouts of the Gymnasium environment ENV_ID, simulated during the import.

        It is rendered with render_mode="rgb_array"; module:Name-v0 imports a module first, and
        module:function calls a function that makes an environment, perhaps wrapped, or a vector
        environment. Actions from a Box keep their values and bounds; actions from a Discrete become
        one-hot vectors. Observations are kept as state if they are vectors.

        Args:
            env_id: id of the environment, as for `gymnasium.make`, or a function that makes it.
            episodes: How many: 100, or 100,10 for train and ind_test; a tenth more for ind_test by
                default.
            policy: What acts: random, or module:function of an observation and a random generator.
            seed: Seed of the dataset: of every episode's start and policy.
            frames: End episodes after this many frames.
            envs: Number of environments to step at once, as a vector environment.
        """
        asked = {"policy": policy, "seed": seed, "frames": frames}
        dataset = rollouts(Named(env_id, envs), _name(env_id), episodes, policy, seed, frames)
        counts = ",".join(map(str, _counts(episodes).values()))
        facts = {"kind": "gymnasium", "name": env_id, "version": version("gymnasium")}
        return replace(dataset, facts=facts, options={"episodes": counts, **asked, "envs": envs})

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """A toy environment that needs no other package."""
        square = "acwm_formats.example:acwm_formats/Square-v0"
        return {"env_id": square, "episodes": (2, 1), "frames": 6}


def rollouts(
    env: Env | Vector | Named,
    name: str,
    episodes: tuple[int, ...],
    policy: str | Policy = RANDOM,
    seed: int = 0,
    frames: int = 1000,
) -> RecordedDataset:
    """Rollouts of an environment to import; one that exists already must be imported by no workers.

    Args:
        env: an environment, a vector environment, or how to make one; it renders ``rgb_array``.
        name: what to call it, one word.
        episodes: how many for train, and perhaps for ind_test; else a tenth more.
        policy: who acts: a function of an observation and a random generator, or its name.
        seed: seed of the dataset.
        frames: most frames of an episode.

    Raises:
        RecipeError: the environment or the policy cannot be made, or there is nothing to make.
        DataError: it does not render frames, or has other actions than `Box` with finite bounds and
            `Discrete`.
    """
    counts = _counts(episodes)
    if frames < 2:
        raise RecipeError(f"--frames {frames}: give at least 2, with an action between them")
    stage = _stage(env)
    _policy(policy)  # which must be there
    recordings: dict[Split, RolloutRecordings] = {
        split: RolloutRecordings(env, policy, EpisodeSpec(name, split, seed=seed), frames, count)
        for split, count in counts.items()
        if count
    }
    if not recordings:
        raise RecipeError("no episodes were requested: every split has 0")
    fps = stage.metadata.get("render_fps")
    notes = () if fps else (f"The environment has no render_fps; {FPS} is assumed.",)
    acts = policy if isinstance(policy, str) else getattr(policy, "__name__", "of its owner")
    title = env.env_id if isinstance(env, Named) else name
    return RecordedDataset(
        name,
        recordings,
        {"kind": "gymnasium", "name": name, "version": version("gymnasium")},
        fps=plain_rate(fps or FPS),
        actions=_action(title, stage.action_space),
        notes=notes if stage.shows_last else (*notes, LAST),
        seed=seed,
        costly=True,
        together=stage.count,
        summary=f"{title} under the policy {acts}",
        engine="Gymnasium",
    )


def _counts(episodes: tuple[int, ...]) -> dict[Split, int]:
    if not 1 <= len(episodes) <= 2 or min(episodes) < 0:
        given = ",".join(map(str, episodes))
        raise RecipeError(f"--episodes {given}: give a number such as 100, or 100,10")
    train, *test = episodes
    return {"train": train, "ind_test": test[0] if test else max(2, train // 10)}


def _name(env_id: str) -> str:
    name = re.sub(r"-v\d+$", "", env_id.rpartition("/")[2].rpartition(":")[2])
    return re.sub(r"\W+", "_", name).strip("_").lower()


@dataclass(frozen=True, eq=False)  # what was played last is remembered by identity
class RolloutRecordings:
    """The rollouts of one split; `spec` is the one of episode 0."""

    env: Env | Vector | Named
    policy: str | Policy
    spec: EpisodeSpec
    frames: int
    count: int

    def __len__(self) -> int:
        """The number of rollouts."""
        return self.count

    def __getitem__(self, index: int) -> Recording:
        """Play a rollout; if the environment is deterministic, an index always gives the same."""
        stage = _stage(self.env)
        take = _played(self, index // stage.count)[index % stage.count]
        return take.recording(stage.observation_space)

    def __getstate__(self) -> dict[str, Any]:
        """What is sent to workers.

        Raises:
            DataError: the environment exists already.
        """
        if not isinstance(self.env, Named):
            raise DataError(
                "an environment that exists already cannot be sent to workers: import it with "
                "workers=0, or give the name of a function that makes it"
            )
        return self.__dict__


@functools.lru_cache(maxsize=1)
def _played(rollouts: RolloutRecordings, batch: int) -> Sequence[Take]:
    """Rollouts that are played at once."""
    stage, spec = _stage(rollouts.env), rollouts.spec
    numbers = range(batch * stage.count, (batch + 1) * stage.count)
    specs = [EpisodeSpec(spec.environment, spec.split, index, spec.seed) for index in numbers]
    return play(stage, _policy(rollouts.policy), specs, rollouts.frames)


@functools.lru_cache(maxsize=1)
def _stage(source: Env | Vector | Named) -> Stage:
    """The environment of this process, cached because it can be expensive to create."""
    env = _environment(source) if isinstance(source, Named) else source
    return Several(env) if isinstance(env, VectorEnv) else Single(env)


def _environment(named: Named) -> Env | Vector:
    env_id, envs = named
    with _from_here():
        try:
            if (make := _function(env_id)) is not None:
                return _made_by(make, named)
            if envs is None:
                return gymnasium.make(env_id, render_mode="rgb_array", disable_env_checker=True)  # pyright: ignore[reportUnknownMemberType]
            if envs < 1:
                raise RecipeError(f"--envs {envs}: give at least 1")
            return gymnasium.make_vec(env_id, envs, render_mode="rgb_array")
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise RecipeError(f"Gymnasium cannot make {env_id!r}: {error}") from error
        except TypeError as error:
            raise DataError(f"{env_id} takes no render_mode='rgb_array' ({error})") from error


def _function(env_id: str) -> Callable[[], Any] | None:
    """The function of ``module:function``, if it is no id that the module registers."""
    module, colon, name = env_id.partition(":")
    if not colon or not name.isidentifier():
        return None
    function = getattr(importlib.import_module(module), name, None)
    return function if callable(function) and name not in gymnasium.registry else None


def _made_by(make: Callable[[], Any], named: Named) -> Env | Vector:
    if named.envs is not None:
        raise RecipeError("--envs is for ids: let the function return a vector environment")
    env = make()
    if not isinstance(env, gymnasium.Env | VectorEnv):
        raise RecipeError(f"{named.env_id} returns {type(env).__name__}, no environment")
    return cast("Env | Vector", env)


class _from_here:
    """Allows imports from the current folder, as `python -m` does."""

    def __enter__(self) -> None:
        self._path = str(Path.cwd())
        sys.path.append(self._path)

    def __exit__(self, *_: object) -> None:
        sys.path.remove(self._path)


def _policy(policy: str | Policy) -> Policy | None:
    """The function that acts; None samples actions."""
    if policy == RANDOM:
        return None
    if not isinstance(policy, str):
        return policy
    with _from_here():
        try:
            function: object = resolve_name(policy)
        except (ImportError, AttributeError, ValueError) as error:
            raise RecipeError(
                f"there is no policy {policy!r} ({error}): give random, or module:function"
            ) from error
    if not callable(function):
        raise RecipeError(
            f"the policy {policy} is not a function of an observation and a generator"
        )
    return function


def _action(env_id: str, space: Any) -> ActionFacts:
    if isinstance(space, Discrete):
        count = int(space.n)
        names = tuple(f"action_{i + int(space.start)}" for i in range(count))
        return ActionFacts(names, bounds=((0.0,) * count, (1.0,) * count))
    if not isinstance(space, Box):
        raise DataError(
            f"{env_id} has actions of the kind {type(space).__name__}: Box and Discrete can be "
            "imported; wrap the environment to give it one of them"
        )
    box = cast(Any, space)
    low, high = (np.asarray(bound, np.float64).reshape(-1) for bound in (box.low, box.high))
    if not np.all(np.isfinite([low, high])) or not np.all(low < high):
        raise DataError(
            f"{env_id} has actions without finite bounds, by which models normalise: wrap it in an "
            "environment whose Box has the bounds that are used, and import that"
        )
    return ActionFacts(bounds=(tuple(low.tolist()), tuple(high.tolist())))
