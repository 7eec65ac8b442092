"""Recordings of worlds that acwm was not tuned for, as anyone would make them: mp4 and CSV.

    pip install "gymnasium[mujoco,box2d]" gymnasium-robotics ale-py dm-control imageio-ffmpeg
    MUJOCO_GL=egl python benchmarks/render_sources.py fetch --out recordings

Each recording is NUMBER.mp4, with a row of NUMBER.csv per frame: its time, and the action that is
held until the next one. Nothing of acwm is imported. `sources.py` trains models on the recordings.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import imageio.v2 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIZE, FPS = 96, 10
"""Pixels on a side, and frames per second."""

SMALL = {"width": 128, "height": 128}
"""What MuJoCo renders, instead of 480 × 480."""


class Source(NamedTuple):
    """A world, and how it is played.

    Args:
        make: its environment, whose `render` returns a picture.
        steps: of the environment per frame, in which the action is held.
        smooth: how much of a random action is kept in the next frame, in [0, 1).
        skipped: steps without an action before a recording begins.
        reach: where an arm should go, from an observation: offsets in the first actions.
    """

    make: Callable[[], Any]
    steps: int = 1
    smooth: float = 0.7
    skipped: int = 0
    reach: Callable[[Any], NDArray[np.float64]] | None = None


def gym(name: str, package: str = "", **options: Any) -> Callable[[], Any]:
    """An environment of Gymnasium."""

    def make() -> Any:
        if package:
            gymnasium.register_envs(__import__(package))
        return gymnasium.make(name, render_mode="rgb_array", disable_env_checker=True, **options)

    return make


class Suite:
    """A task of dm_control's suite, by the interface of Gymnasium that is used here."""

    def __init__(self, domain: str, task: str) -> None:
        from dm_control import suite

        self.load = lambda seed: suite.load(domain, task, task_kwargs={"random": seed})
        self.env = self.load(0)
        limits = self.env.action_spec()
        self.action_space = gymnasium.spaces.Box(limits.minimum, limits.maximum, dtype=np.float64)

    def reset(self, seed: int) -> tuple[Any, Any]:
        """Begin an episode."""
        self.env = self.load(seed)
        return self.env.reset().observation, None

    def step(self, action: NDArray[np.float64]) -> tuple[Any, ...]:
        """Move on."""
        return self.env.step(action).observation, 0.0, False, False, {}

    def render(self) -> NDArray[np.uint8]:
        """The picture of the first camera."""
        flat = {"shadow": False, "reflection": False}  # which cost most without a GPU
        return self.env.physics.render(SIZE, SIZE, camera_id=0, render_flag_overrides=flat)


def to_block(observation: Any) -> NDArray[np.float64]:
    """From the gripper of a Fetch robot to its block."""
    values = observation["observation"]
    return 8 * (values[3:6] - values[:3])


SOURCES: dict[str, Source] = {
    "car_racing": Source(gym("CarRacing-v3", max_episode_steps=-1), 5, 0.6, 50),
    "pong": Source(gym("ALE/Pong-v5", "ale_py", repeat_action_probability=0.0), 1, 0.0, 15),
    "breakout": Source(gym("ALE/Breakout-v5", "ale_py", repeat_action_probability=0.0), 1, 0.0),
    "lunar_lander": Source(gym("LunarLander-v3", continuous=True), 5, 0.5),
    "pusher": Source(gym("Pusher-v5", width=128, height=128), 2),
    "fetch": Source(
        gym("FetchPush-v4", "gymnasium_robotics", width=128, height=128), 2, 0.6, 0, to_block
    ),
    "ball_in_cup": Source(lambda: Suite("ball_in_cup", "catch"), 5, 0.5),
    "finger": Source(lambda: Suite("finger", "spin"), 5, 0.5),
    "manipulator": Source(lambda: Suite("manipulator", "bring_ball"), 10, 0.7),
}


class Player:
    """Actions that change smoothly, or by chance where they are buttons."""

    def __init__(self, source: Source, space: Any, seed: int) -> None:
        self.source, self.space, self.random = source, space, np.random.default_rng(seed)
        self.noise = self.random.normal(size=space.shape)
        self.button, self.follows = 0, source.reach is not None and self.random.random() < 0.7

    @property
    def buttons(self) -> bool:
        """If an action is one of some numbers."""
        return isinstance(self.space, gymnasium.spaces.Discrete)

    def act(self, observation: Any) -> Any:
        """The next action."""
        if self.buttons:
            if self.random.random() < 0.3:
                self.button = int(self.random.integers(self.space.n))
            return self.button
        kept = self.source.smooth
        self.noise = kept * self.noise + (1 - kept**2) ** 0.5 * self.random.normal(
            size=self.space.shape
        )
        action = 0.5 * self.noise
        if self.follows and self.source.reach is not None:
            offsets = self.source.reach(observation)
            action[: len(offsets)] += offsets
        middle = (self.space.high + self.space.low) / 2
        half = (self.space.high - self.space.low) / 2
        return (middle + half * np.clip(action, -1, 1)).astype(self.space.dtype)


def record(source: Source, env: Any, seed: int, frames: int) -> tuple[list[Any], list[Any]]:
    """Frames `[H, W, 3]`, and the action from each to the next."""
    observation, _ = env.reset(seed=seed)
    player = Player(source, env.action_space, seed)
    rest = 0 if player.buttons else np.zeros(env.action_space.shape, env.action_space.dtype)
    for _ in range(source.skipped):
        observation, *_ = env.step(rest)
    video, actions = [], []
    for _ in range(frames):
        picture = Image.fromarray(np.ascontiguousarray(env.render()))
        video.append(np.asarray(picture.resize((SIZE, SIZE), Image.Resampling.BOX)))
        actions.append(player.act(observation))
        ended = False
        for _ in range(source.steps):
            observation, _, ended, *_ = env.step(actions[-1])
            if ended:
                break
        if ended:
            break
    return video, actions


def main() -> None:
    """Write the recordings of a world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", choices=SOURCES)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recordings", type=int, default=130)
    parser.add_argument("--frames", type=int, default=40)
    options = parser.parse_args()
    source, folder = SOURCES[options.source], options.out / options.source
    folder.mkdir(parents=True, exist_ok=True)
    env = source.make()
    for number in range(options.recordings):
        video, actions = record(source, env, number, options.frames)
        iio.mimwrite(folder / f"{number:03d}.mp4", video, fps=FPS, quality=9)
        with (folder / f"{number:03d}.csv").open("w", newline="") as file:
            rows = np.atleast_2d(np.asarray(actions, float).reshape(len(actions), -1))
            writer = csv.writer(file)
            writer.writerow(["time", *(f"action_{place}" for place in range(rows.shape[1]))])
            writer.writerows([frame / FPS, *row] for frame, row in enumerate(rows))


if __name__ == "__main__":
    main()
