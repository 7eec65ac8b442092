"""Small recordings for the conformance tests of formats."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from acwm_core.data.video import write_mp4
from acwm_formats.format import Format, export_dataset
from acwm_formats.recordings import import_dataset
from acwm_formats.rollouts import Gymnasium


class Square(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A square of 8×8 pixels that the action moves in a frame of 32×32."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    action_space = Box(-1, 1, (2,), np.float32)
    observation_space = Box(0, 24, (2,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._place = np.zeros(2, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start at a random position."""
        super().reset(seed=seed)
        self._place = self.np_random.uniform(0, 24, 2).astype(np.float32)
        return self._place.copy(), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        """Move by up to 4 pixels."""
        self._place = np.clip(self._place + 4 * action, 0, 24)
        return self._place.copy(), 0.0, False, False, {}

    def render(self) -> Any:
        """Draw the frame."""
        frame = np.full((32, 32, 3), 60, np.uint8)
        row, column = self._place.astype(int)
        frame[row : row + 8, column : column + 8] = 220
        return frame


gymnasium.register("acwm_formats/Square-v0", f"{Square.__module__}:Square")


def write_example_videos(folder: Path) -> None:
    """Write rollouts of `Square` as MP4 files of 10 frames per second, with a CSV beside each."""
    for seed, length in enumerate((6, 7, 8)):
        env, rng = Square(), np.random.default_rng(seed)
        env.reset(seed=seed)
        frames, lines = [env.render()], ["time,right,down"]
        for index in range(length - 1):
            down, right = rng.uniform(-1, 1, 2)
            env.step(np.array([down, right], np.float32))
            frames.append(env.render())
            lines.append(f"{index / 10},{right},{down}")
        write_mp4(folder / f"square_{seed}.mp4", np.stack(frames))
        (folder / f"square_{seed}.csv").write_text("\n".join(lines), encoding="utf-8")


def exported_example(folder: Path, target: Format) -> Path:
    """Export a few rollouts of `Square` to another format; returns a folder below `folder`."""
    with tempfile.TemporaryDirectory() as data:
        rollouts = Gymnasium().read(**Gymnasium.example(folder))
        import_dataset(rollouts, data, workers=0, progress=False)
        return export_dataset(data, folder / "square", target, progress=False)
