"""`DreamVector`: ``gymnasium.make_vec("acwm/dream-v0", num_envs=…, run=…, task=…)``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from acwm_core.env.environment import checked_seed
from acwm_core.errors import AcwmError, RecipeError, ShapeError
from acwm_dream.dreams import Dreams, Frames, StepResult, settings_of, spaces_of


class DreamVector(gymnasium.vector.VectorEnv[Frames, NDArray[np.float32], NDArray[Any]]):
    """Parallel dreams that the model predicts together.

    Like `Dream`, with a leading axis of episodes. An episode that has ended restarts in the next
    step, as in Gymnasium's `AutoresetMode.NEXT_STEP`: that step ignores its action, and its reward
    is 0. Episodes that started together are predicted in one batch; others are predicted
    separately.

    Args:
        num_envs: number of episodes.
        **settings: see `DreamSettings`.
    """

    def __init__(self, *, num_envs: int = 1, **settings: Any) -> None:
        if num_envs < 1:
            raise RecipeError(f"num_envs={num_envs}: give 1 or more")
        self.num_envs = num_envs
        self._dreams = Dreams(settings_of(settings), num_envs)
        card, self.repeat = self._dreams.card, self._dreams.repeat
        self.metadata = {
            "autoreset_mode": AutoresetMode.NEXT_STEP,
            "render_fps": card.fps / self.repeat,
        }
        self.single_observation_space, self.single_action_space = spaces_of(self._dreams)
        batched = gymnasium.vector.utils.batch_space
        self.observation_space = batched(self.single_observation_space, num_envs)
        self.action_space = batched(self.single_action_space, num_envs)
        self._steps = np.full(num_envs, -1)
        self._over = np.zeros(num_envs, np.bool_)
        self._rngs = [np_random()[0] for _ in range(num_envs)]
        self._frames = np.zeros((num_envs, *card.frame_size, 3), np.uint8)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | NDArray[np.integer[Any]] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Frames, dict[str, Any]]:
        """Start all episodes. With a single seed, episode k uses that seed + k.

        Options are those of `Dream.reset`, and apply to all episodes.
        """
        if isinstance(seed, Sequence) or np.ndim(cast(Any, seed)):
            seeds = [checked_seed(each) for each in cast(Iterable[Any], seed)]
        else:
            first = checked_seed(seed)
            places = range(self.num_envs)
            seeds = [None if first is None else first + place for place in places]
        if len(seeds) != self.num_envs:
            raise RecipeError(f"{len(seeds)} seeds for {self.num_envs} environments")
        for place, each in enumerate(seeds):
            if each is not None:
                self._rngs[place] = np_random(each)[0]
        info: dict[str, Any] = {}
        self._over = np.zeros(self.num_envs, np.bool_)
        self._begin(list(range(self.num_envs)), options or {}, info)
        return self._frames.copy(), info

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Frames, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Predict one latent frame of each episode; see `Dream.step`."""
        if (self._steps < 0).any():
            raise AcwmError("call reset() before step()")
        rows = np.asarray(actions, np.float32)
        if rows.shape != self.action_space.shape:
            raise ShapeError(f"actions are {self.action_space.shape}, not {rows.shape}")
        ended, running = (np.flatnonzero(each).tolist() for each in (self._over, ~self._over))
        rewards, solved = np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)
        info: dict[str, Any] = {}
        if running:
            result = self._dreams.step(running, rows[running])
            self._steps[running] += 1
            rewards[running], solved[running] = result.rewards, result.success
            self._show(running, result, info)
        if ended:
            self._begin(ended, {}, info)
        late = self._steps >= self._dreams.max_steps
        self._over = solved | late
        return self._frames.copy(), rewards, solved, late, info

    def close_extras(self, **kwargs: Any) -> None:
        """Free all resources."""
        self._dreams.starts.close()

    def _begin(self, which: list[int], options: dict[str, Any], info: dict[str, Any]) -> None:
        """Start some episodes."""
        starts = [self._dreams.start(self._rngs[place], options) for place in which]
        seeds = [int(self._rngs[place].integers(2**31)) for place in which]
        self._steps[which] = 0
        self._show(which, self._dreams.restart(which, starts, seeds), info)
        if self._dreams.task is not None:
            goals = np.empty(len(starts), object)
            goals[:] = [start.goal for start in starts]
            self._fill(info, "goal", which, goals)

    def _show(self, which: list[int], result: StepResult, info: dict[str, Any]) -> None:
        self._frames[which] = result.frames
        if self._dreams.task is not None:
            for name in ("distance", "success", "failed"):
                self._fill(info, name, which, getattr(result, name))
        for name, values in result.states.items():
            self._fill(info.setdefault("state", {}), name, which, values)

    def _fill(
        self, info: dict[str, Any], name: str, which: list[int], values: NDArray[Any]
    ) -> None:
        """Fill `info` as Gymnasium does: an array for all episodes, and a mask of valid entries."""
        if name not in info:
            info[name] = np.zeros((self.num_envs, *values.shape[1:]), values.dtype)
            info[f"_{name}"] = np.zeros(self.num_envs, np.bool_)
        info[name][which], info[f"_{name}"][which] = values, True
