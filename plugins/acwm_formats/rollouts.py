"""Rollouts in Gymnasium environments as recordings: rendered frames while a policy acts."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from acwm_core.env.card import plain_rate
from acwm_core.env.episode import EpisodeSpec, Split
from acwm_core.errors import DataError, RecipeError
from acwm_formats.format import Format
from acwm_formats.timeline import ActionFacts, RecordedDataset, Recording

RANDOM = "random"
OBSERVATION = "observation"
FPS = 10  # for environments without `render_fps`

Policy = Callable[[Any, np.random.Generator], Any]
"""Maps an observation and the random generator of the episode to an action."""


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
    ) -> RecordedDataset:
        """Import rollouts of the Gymnasium environment ENV_ID, simulated during the import.

        It is rendered with render_mode="rgb_array"; module:Name-v0 imports a module first. Actions
        from a Box keep their values and bounds; actions from a Discrete become one-hot vectors.
        Observations are kept as state if they are vectors.

        Args:
            env_id: id of the environment, as for `gymnasium.make`.
            episodes: How many: 100, or 100,10 for train and ind_test; a tenth more for ind_test by
                default.
            policy: Who acts: random, or module:function of an observation and a random generator.
            seed: Seed of the dataset: of every episode's start and policy.
            frames: End episodes after this many frames.
        """
        counts, name = _counts(episodes, frames), _name(env_id)
        env = _environment(env_id)
        _policy(policy, env)  # which must be there
        made: dict[Split, Rollouts] = {
            split: Rollouts(env_id, policy, EpisodeSpec(name, split, seed=seed), frames, count)
            for split, count in counts.items()
            if count
        }
        if not made:
            raise RecipeError("there are no episodes to make: every split has 0")
        fps = env.metadata.get("render_fps")
        return RecordedDataset(
            name,
            made,
            {"kind": "gymnasium", "name": env_id, "version": version("gymnasium")},
            fps=plain_rate(fps or FPS),
            options={
                "episodes": ",".join(map(str, counts.values())),
                "policy": policy,
                "seed": seed,
                "frames": frames,
            },
            actions=_action(env_id, env.action_space),
            notes=() if fps else (f"The environment has no render_fps; {FPS} are assumed.",),
            seed=seed,
            costly=True,
            summary=f"{env_id} under the policy {policy}",
            engine="Gymnasium",
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """A toy environment that needs no other package."""
        square = "acwm_formats.example:acwm_formats/Square-v0"
        return {"env_id": square, "episodes": (2, 1), "frames": 6}


def _counts(episodes: tuple[int, ...], frames: int) -> dict[Split, int]:
    if not 1 <= len(episodes) <= 2 or min(episodes) < 0:
        given = ",".join(map(str, episodes))
        raise RecipeError(f"--episodes {given}: give a number such as 100, or 100,10")
    if frames < 2:
        raise RecipeError(f"--frames {frames}: give at least 2, with an action between them")
    train, *test = episodes
    return {"train": train, "ind_test": test[0] if test else max(2, train // 10)}


def _name(env_id: str) -> str:
    name = re.sub(r"-v\d+$", "", env_id.rpartition("/")[2].rpartition(":")[2])
    return re.sub(r"\W+", "_", name).strip("_").lower()


@dataclass(frozen=True)
class Rollouts:
    """The rollouts of one split; `spec` is the one of episode 0."""

    env_id: str
    policy: str
    spec: EpisodeSpec
    frames: int
    count: int

    def __len__(self) -> int:
        """The number of rollouts."""
        return self.count

    def __getitem__(self, index: int) -> Recording:
        """Play a rollout; if the environment is deterministic, an index always gives the same."""
        env = _environment(self.env_id)
        spec = EpisodeSpec(self.spec.environment, self.spec.split, index, self.spec.seed)
        rng = spec.rng("policy")
        env.action_space.seed(int(rng.integers(2**31)))
        act = _policy(self.policy, env)
        observation, _ = env.reset(seed=int(spec.rng("reset").integers(2**31)))
        images, taken = [_frame(env)], list[NDArray[np.float32]]()
        seen = [np.array(observation)]  # copies: an environment may reuse its arrays
        ended = False
        while not ended and len(images) < self.frames:
            action = act(observation, rng)
            taken.append(_vector(env.action_space, action))
            observation, _, terminated, truncated, _ = env.step(action)
            images.append(_frame(env))
            seen.append(np.array(observation))
            ended = terminated or truncated
        space: Any = env.observation_space
        vectors = isinstance(space, Box) and len(space.shape) == 1
        if len({image.shape for image in images}) > 1:
            raise DataError("its render() returns frames of several sizes")
        states = {OBSERVATION: np.stack(seen)} if vectors else {}
        return Recording(np.stack(images), np.stack(taken), states)


@functools.lru_cache(maxsize=1)
def _environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """The environment of this process, cached because it can be expensive to create."""
    with _from_here():
        try:
            return gymnasium.make(env_id, render_mode="rgb_array", disable_env_checker=True)  # pyright: ignore[reportUnknownMemberType]
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise RecipeError(f"Gymnasium cannot make {env_id!r}: {error}") from error
        except TypeError as error:
            raise DataError(f"{env_id} takes no render_mode='rgb_array' ({error})") from error


class _from_here:
    """Allows imports from the current folder, as `python -m` does."""

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
        raise RecipeError(f"the policy {name} is not a function of an observation and a generator")
    return found


def _action(env_id: str, space: gymnasium.Space[Any]) -> ActionFacts:
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


def _vector(space: gymnasium.Space[Any], action: Any) -> NDArray[np.float32]:
    if isinstance(space, Discrete):
        return np.eye(int(space.n), dtype=np.float32)[int(action) - int(space.start)]
    return np.array(action, np.float32).reshape(-1)


def _frame(env: gymnasium.Env[Any, Any]) -> NDArray[np.uint8]:
    try:
        frame = np.array(env.render())
    except Exception as error:  # e.g. OpenGL or a drawing library is missing
        reason = f"{type(error).__name__}: {error}"
        raise DataError(f"the environment cannot be rendered ({reason})") from error
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise DataError("its render() returns no uint8 frame [H, W, 3]")
    return frame
