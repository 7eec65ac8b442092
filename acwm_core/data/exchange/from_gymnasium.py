"""Import of rollouts in a Gymnasium environment: what its camera sees while a policy acts."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from acwm_core.data.exchange.area import target_size
from acwm_core.data.exchange.recording import Recording, recorded_card
from acwm_core.data.exchange.source import Source, import_command
from acwm_core.environment import ActionSpec, StateField
from acwm_core.episode import EpisodeSpec, Split
from acwm_core.errors import DataError, RecipeError

RANDOM = "random"
OBSERVATION = "observation"
MOST_FRAMES = 1000
FPS = 10  # of environments that do not say

Policy = Callable[[Any, np.random.Generator], Any]
"""From an observation, and a generator of its episode's own, to an action of the environment."""


def gymnasium_source(
    env_id: str,
    *,
    episodes: Mapping[Split, int],
    policy: str = RANDOM,
    seed: int = 0,
    frames: int = MOST_FRAMES,
    environment: str | None = None,
    size: int | tuple[int, int] | None = None,
) -> Source:
    """Rollouts of a Gymnasium environment, made when they are read.

    Frames are what `render` returns with ``render_mode="rgb_array"``. Actions of a `Box` come as
    they are, with its bounds; those of a `Discrete` as one-hot vectors. Observations are kept as
    state where they are vectors.

    Args:
        env_id: as `gymnasium.make` takes it; ``"module:Name-v0"`` imports a module first.
        episodes: how many rollouts per split.
        policy: ``"random"`` samples the action space; ``"module:function"`` is called with the
            observation and a random generator and returns an action.
        seed: every episode's start and policy are seeded from it.
        frames: an episode ends after so many, if the environment does not end it before.
        environment: what to call it; the id's name by default.
        size: frame size, a side or ``(H, W)``; by default that of the rendered frames, each side
            rounded down to a multiple of 8.

    Raises:
        RecipeError: no such environment or policy.
        DataError: it renders no frames, or its actions are of another kind or have no bounds.
    """
    env = _environment(env_id)
    action = _action(env_id, env.action_space)
    name = environment or re.sub(r"-v\d+$", "", env_id.rpartition("/")[2].rpartition(":")[2])
    name = re.sub(r"\W+", "_", name).strip("_").lower()
    made: dict[Split, Rollouts] = {
        split: Rollouts(env_id, policy, EpisodeSpec(name, split, seed=seed), frames, count)
        for split, count in episodes.items()
        if count
    }
    if not made:
        raise RecipeError("there are no episodes to make: every split has 0")
    probe = next(iter(made.values()))[0]
    limit = env.spec.max_episode_steps if env.spec else None
    fps = env.metadata.get("render_fps")
    card = recorded_card(
        name,
        action,
        frame_size=target_size((probe.video.shape[1], probe.video.shape[2]), size),
        fps=round(fps or FPS),
        horizon=min(frames, limit + 1) if limit else probe.frames,
        state=[
            StateField(n, rows.shape[1:], "", "as observed") for n, rows in probe.states.items()
        ],
        summary=f"{env_id} under the policy {policy}",
        engine="Gymnasium",
    )
    counts = ",".join(str(episodes.get(split, 0)) for split in ("train", "ind_test"))
    options = {"policy": policy, "seed": seed, "frames": frames, "environment": environment}
    facts = {
        "kind": "gymnasium",
        "name": env_id,
        "command": import_command(
            "gymnasium", env_id, episodes=counts, **options, size=card.frame_size
        ),
        "version": version("gymnasium"),
    }
    notes = () if fps else (f"The environment names no render_fps; {FPS} are taken.",)
    return Source(card, made, facts, notes, seed)


@dataclass(frozen=True)
class Rollouts:
    """The rollouts of one split; `spec` is that of its episode 0."""

    env_id: str
    policy: str
    spec: EpisodeSpec
    frames: int
    count: int

    def __len__(self) -> int:
        """How many there are."""
        return self.count

    def __getitem__(self, index: int) -> Recording:
        """Play one; the same index gives the same rollout, as far as the environment repeats."""
        env = _environment(self.env_id)
        spec = EpisodeSpec(self.spec.environment, self.spec.split, index, self.spec.seed)
        rng = spec.rng("policy")
        env.action_space.seed(int(rng.integers(2**31)))
        act = _policy(self.policy, env)
        observation, _ = env.reset(seed=int(spec.rng("reset").integers(2**31)))
        images, seen, taken = [_frame(env)], [observation], cast(list[NDArray[Any]], [])
        ended = False
        while not ended and len(images) < self.frames:
            action = act(observation, rng)
            observation, _, terminated, truncated, _ = env.step(action)
            taken.append(_vector(env.action_space, action))
            images.append(_frame(env))
            seen.append(observation)
            ended = terminated or truncated
        space: Any = env.observation_space
        vectors = isinstance(space, Box) and len(space.shape) == 1
        states = {OBSERVATION: np.stack(seen)} if vectors else {}
        return Recording(np.stack(images), np.stack(taken), states)


@functools.lru_cache(maxsize=1)
def _environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """This process's environment, which can be costly to make."""
    with _from_here():
        try:
            return gymnasium.make(env_id, render_mode="rgb_array", disable_env_checker=True)  # pyright: ignore[reportUnknownMemberType]
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise RecipeError(f"Gymnasium cannot make {env_id!r}: {error}") from error
        except TypeError as error:
            raise DataError(f"{env_id} takes no render_mode='rgb_array' ({error})") from error


class _from_here:
    """Lets modules in the current folder be imported, as `python -m` does."""

    def __enter__(self) -> None:
        self._path = str(Path.cwd())
        sys.path.append(self._path)

    def __exit__(self, *_: object) -> None:
        sys.path.remove(self._path)


def _policy(name: str, env: gymnasium.Env[Any, Any]) -> Policy:
    if name == RANDOM:
        return lambda observation, rng: env.action_space.sample()
    with _from_here():
        try:
            found: object = resolve_name(name)
        except (ImportError, AttributeError, ValueError) as error:
            raise RecipeError(
                f"there is no policy {name!r} ({error}): give random, or module:function"
            ) from error
    if not callable(found):
        raise RecipeError(f"the policy {name} is no function of an observation and a generator")
    return found


def _action(env_id: str, space: gymnasium.Space[Any]) -> ActionSpec:
    if isinstance(space, Discrete):
        count = int(space.n)
        names = tuple(f"action_{i + int(space.start)}" for i in range(count))
        return ActionSpec(names, ("",) * count, (0.0,) * count, (1.0,) * count, "absolute")
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
    names = tuple(f"action_{i}" for i in range(len(low)))
    units = ("",) * len(low)
    return ActionSpec(names, units, tuple(low.tolist()), tuple(high.tolist()), "absolute")


def _vector(space: gymnasium.Space[Any], action: Any) -> NDArray[np.float32]:
    if isinstance(space, Discrete):
        return np.eye(int(space.n), dtype=np.float32)[int(action) - int(space.start)]
    return np.asarray(action, np.float32).reshape(-1)


def _frame(env: gymnasium.Env[Any, Any]) -> NDArray[np.uint8]:
    try:
        frame = np.asarray(env.render())
    except Exception as error:  # e.g. no OpenGL, or a library for drawing that is not installed
        reason = f"{type(error).__name__}: {error}"
        raise DataError(f"the environment cannot be rendered ({reason})") from error
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise DataError("its render() returns no uint8 frame [H, W, 3]")
    return frame
