"""The held cup and the container: their sizes, and how the cup follows its target."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

THICKNESS = 0.03
"""Thickness of walls and floors in metres."""

STIFFNESS = 7.0
"""Natural frequency in rad/s of the spring that pulls the cup to its target. Damping is critical,
so 95 % of a step is completed after 0.7 s, without overshoot."""

LOW, HIGH = np.array([-1.55, -0.6, 0.0, -0.6]), np.array([0.6, 0.6, 2.0, 2.3])
"""Bounds of the cup's target: x, y, z in metres, tilt in rad."""

CLEARANCE = 0.02
"""Least distance in metres between the cup and the table."""


@dataclass(frozen=True)
class Vessel:
    """An open round vessel.

    Attributes:
        inner: inner radius in metres.
        tall: height of its inside in metres.
    """

    inner: float
    tall: float

    @property
    def outer(self) -> float:
        """Outer radius in metres."""
        return self.inner + THICKNESS

    @property
    def outline(self) -> NDArray[np.float64]:
        """[M, 3] points on the outer surface, relative to the middle of the inside."""
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        around = np.stack([np.cos(turn), np.sin(turn)], 1) * self.outer
        heights = np.linspace(-self.tall / 2 - THICKNESS, self.tall / 2, 7)
        return np.array([[x, y, z] for z in heights for x, y in around])


def tilted(tilt: float) -> NDArray[np.float64]:
    """[3, 3] rotation about the y axis that tilts the top towards +x by `tilt` rad."""
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


class Cup:
    """A cup on a spring and a damper, and a container that it cannot enter.

    The spring pulls the cup's pose (x, y, z of the middle of its inside, tilt) to a target; the
    weight of the water is ignored. If the container or the table blocks the way, the cup stops and
    the target does not run ahead.

    Args:
        shape: shape of the cup.
        container: shape of the container.
        place: [2] position of the container on the table.
        pose: [4] initial pose of the cup, at rest.

    Attributes:
        pose: [4] current pose.
        velocity: [4] m/s and rad/s.
        target: [4] the pose that the spring pulls the cup to.
        touches_container: whether the cup touched the container in the last frame.
        touches_table: whether the cup touched the table in the last frame.
    """

    def __init__(
        self,
        shape: Vessel,
        container: Vessel,
        place: NDArray[np.float64],
        pose: NDArray[np.float64],
    ) -> None:
        self.shape, self.container, self.place = shape, container, place
        self._outline = shape.outline
        self.touches_container = self.touches_table = False
        self.pose = self.free(np.asarray(pose, np.float64))
        self.velocity, self.target = np.zeros(4), self.pose.copy()

    def advance(self, action: NDArray[np.float64], seconds: float, steps: int) -> NDArray:
        """Move the target by `action` and let the cup follow; returns its poses [steps + 1, 4]."""
        self.touches_container = self.touches_table = False
        first = self.target
        wanted = np.clip(first + action, LOW, HIGH)
        path, dt = [self.pose], seconds / steps
        decay = np.exp(-STIFFNESS * dt)
        for step in range(1, steps + 1):
            goal = first + (wanted - first) * (step / steps)
            off = self.pose - goal
            pull = self.velocity + STIFFNESS * off
            swung = goal + (off + pull * dt) * decay
            pose = self.free(swung)
            blocked = pose != swung
            eased = (self.velocity - STIFFNESS * pull * dt) * decay
            self.velocity = np.where(blocked, (pose - self.pose) / dt, eased)
            self.pose = pose
            path.append(pose)
        touched = self.touches_container, self.touches_table
        self.target = np.clip(self.free(wanted), LOW, HIGH)
        # Only contacts of the cup itself count, not those of its target.
        self.touches_container, self.touches_table = touched
        return np.array(path)

    def free(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move a pose out of the container and off the table, on the shortest way."""
        pose = pose.copy()
        points = self._outline @ tilted(float(pose[3])).T
        below = CLEARANCE - (points[:, 2] + pose[2]).min()
        if below > 0:
            pose[2] += below
            self.touches_table = True
        rim, reach = self.container.tall + THICKNESS, self.container.outer
        for _ in range(4):
            flat, height = points[:, :2] + pose[:2] - self.place, points[:, 2] + pose[2]
            away = np.hypot(flat[:, 0], flat[:, 1])
            inside = (away < reach - 1e-9) & (height < rim - 1e-9)
            if not inside.any():
                break
            self.touches_container = True
            up, deepest = rim - height[inside].min(), int(np.argmin(np.where(inside, away, np.inf)))
            aside = reach - away[deepest]
            if up <= aside:
                pose[2] += up
            else:
                pose[:2] += flat[deepest] / max(away[deepest], 1e-9) * aside
        return pose
