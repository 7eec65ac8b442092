"""`Dream`: ``gymnasium.make("acwm/dream-v0", run=…, task=…)``."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import checked_seed
from acwm_core.errors import AcwmError, RecipeError
from acwm_dream.dreams import Dreams, Frames, StepResult, settings_of, spaces_of


class Dream(gymnasium.Env[Frames, NDArray[np.float32]]):
    """A world model as a Gymnasium environment.

    Observations are the frames that the model predicts, ``[H, W, 3]`` uint8. A step is one latent
    frame: its action, raw and in the units of the card, is held for `repeat` video frames, as with
    `gymnasium.wrappers.RepeatAction`. With a task, an estimator reads the states of each video
    frame: the reward is minus the sum of their distances from the goal, and success ends the
    episode. With a learnt reward, it is the sum of its predictions, at most the highest recorded
    one each, of the states that the model carries, or that an estimator reads. `info` has
    ``distance``, ``success``, ``failed`` and ``state`` (these fields). The `info` of `reset` also
    has ``goal``.

    `reset` takes the options of the simulator (``spec``, ``split``, ``factors``), or ``episode``,
    the number of a dataset's episode, or ``frame``, a picture ``[H, W, 3]`` uint8, together with
    ``goal``, a `Goal` or its picture.

    Args:
        render_mode: see Gymnasium; ``"rgb_array"`` or None.
        **settings: see `DreamSettings`.

    Attributes:
        repeat: video frames per step.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(
        self, *, render_mode: Literal["rgb_array"] | None = "rgb_array", **settings: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise RecipeError(f"render_mode={render_mode!r}: frames are rendered as 'rgb_array'")
        self._dreams = Dreams(settings_of(settings), 1)
        card, self.repeat, self.render_mode = self._dreams.card, self._dreams.repeat, render_mode
        self.metadata = {**self.metadata, "render_fps": card.fps / self.repeat}
        self.observation_space, self.action_space = spaces_of(self._dreams)
        self._steps = -1
        self._frame = np.zeros((*card.frame_size, 3), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Frames, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=checked_seed(seed))
        start = self._dreams.start(self.np_random, options or {})
        result = self._dreams.restart([0], [start], [int(self.np_random.integers(2**31))])
        self._steps, self._frame = 0, result.frames[0]
        info = self._info(result)
        return self._frame.copy(), info if start.goal is None else {**info, "goal": start.goal}

    def step(self, action: NDArray[np.float32]) -> tuple[Frames, float, bool, bool, dict[str, Any]]:
        """Predict one latent frame under one action.

        Raises:
            ShapeError: `reset` was not called, or the action has the wrong size, is not finite, or
                is out of bounds.
        """
        if self._steps < 0:
            raise AcwmError("call reset() before step()")
        result = self._dreams.step([0], np.asarray(action, np.float32)[None])
        self._steps, self._frame = self._steps + 1, result.frames[0]
        over = self._steps >= self._dreams.max_steps
        reward, success = float(result.rewards[0]), bool(result.success[0])
        return self._frame.copy(), reward, success, over, self._info(result)

    def render(self) -> Frames:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The current frame, `[H, W, 3]` uint8."""
        return self._frame.copy()

    def close(self) -> None:
        """Free all resources."""
        self._dreams.starts.close()

    def _info(self, result: StepResult) -> dict[str, Any]:
        state = {name: values[0] for name, values in result.states.items()}
        info: dict[str, Any] = {"state": state}
        if self._dreams.task is not None:
            info |= {"distance": float(result.distance[0]), "success": bool(result.success[0])}
            info["failed"] = bool(result.failed[0])
        return info
