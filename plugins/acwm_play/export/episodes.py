"""Recorded episodes of the simulator, for a page without a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_play.layout import Pointing
from acwm_play.simulator import SceneSpec, Simulator

EPISODE_COUNT = 4
EPISODE_SECONDS = 12.0
"""Length of each episode after the given frames."""


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode with the world's behaviour policy.

    Attributes:
        index: number of the scene.
        frames: video frames, `[T, H, W, 3]` uint8.
        actions: raw actions, `[T − 1, A]`; row i leads from frame i to frame i + 1.
        stills: the action that means no motion at each frame, `[T, A]`.
    """

    index: int
    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    stills: NDArray[np.float32]

    def about(self) -> dict[str, Any]:
        """Everything for the page except the frames."""
        return {
            "index": self.index,
            "frames": len(self.frames),
            "actions": self.actions.tolist(),
            "stills": self.stills.tolist(),
        }


def record(simulator: Simulator, index: int, given: int, stride: int) -> RecordedEpisode:
    """Simulate a scene.

    Args:
        simulator: simulator of the world.
        index: number of the scene.
        given: number of first frames without motion, which a model starts from.
        stride: video frames per latent frame; the episode ends with a whole latent frame.
    """
    latent_frames = round(EPISODE_SECONDS * simulator.card.fps / stride)
    time_steps = simulator.start(SceneSpec(index), given)
    stills = [simulator.still()] * given
    for _ in range(stride * latent_frames):
        time_steps.append(simulator.step_by_policy(anew=False))
        stills.append(simulator.still())
    return RecordedEpisode(
        index,
        np.stack([time_step.frame for time_step in time_steps]),
        np.stack([time_step.action for time_step in time_steps[1:]]),
        np.stack(stills).astype(np.float32),
    )


def maps(pointing: Pointing, low: tuple[float, ...], high: tuple[float, ...]) -> list[Any]:
    """A pair of homographies per place: to two dimensions of the action, and back.

    A camera maps a plane by a homography (Hartley and Zisserman 2004, section 4.1), so nine numbers
    hold everything that `pointing` knows.
    """
    shares = np.stack(np.meshgrid(*[np.linspace(0, 1, 4)] * 2), -1).reshape(-1, 2)
    homographies: list[Any] = []
    for k in range(len(low) // 2):
        ends = [np.array(bound)[2 * k : 2 * k + 2] for bound in (low, high)]
        actions = ends[0] + shares * (ends[1] - ends[0])
        whole = np.tile((np.array(low) + high) / 2, (len(actions), 1))
        whole[:, 2 * k : 2 * k + 2] = actions
        places = np.stack([pointing.places(row)[k] for row in whole])
        forward = _homography(places, actions)
        homographies.append([forward.tolist(), np.linalg.inv(forward).tolist()])
    return homographies


def _homography(sources: NDArray[np.float64], targets: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix `[3, 3]` that maps points `[N, 2]` to others, by the direct linear transform."""
    rows: list[NDArray[np.float64]] = []
    zero = np.zeros(3)
    for place, (x, y) in zip(sources, targets, strict=True):
        source = np.append(place, 1.0)
        rows += [np.concatenate([source, zero, -x * source])]
        rows += [np.concatenate([zero, source, -y * source])]
    return np.linalg.svd(np.stack(rows))[2][-1].reshape(3, 3)
