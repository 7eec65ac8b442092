"""Time a path of joint angles, within limits of speed and acceleration."""

import itertools

import numpy as np
from numpy.typing import NDArray

from acwm_kinematics.arm_planner import Clearance, Joints

MAX_SPEED = 1.15
"""Largest speed of any joint in a planned motion, rad/s."""

MAX_ACCELERATION = 5.0
"""Largest acceleration of any joint in a planned motion, rad/s²."""

_IN_BENDS = 0.3
"""Share of the acceleration used in bends; half is for speeding up, the rest for grid errors."""

_NOWHERE = 1e-9  # rad
_SPACING = 0.01  # rad along the path between two points of the fine path


def rounded(clearance: Clearance, path: Joints, reach: float = 0.3) -> Joints:
    """Replace the corners of a path by parabolas that are as wide as the free space allows.

    Args:
        clearance: the collision checker.
        path: polyline [K, 7], rad.
        reach: largest distance from a corner at which a parabola may begin, rad.
    """
    pieces, before = [path[:1]], path[0]
    for corner, after in itertools.pairwise(path[1:]):
        back, ahead = before - corner, after - corner
        lengths = np.linalg.norm(back), np.linalg.norm(ahead)
        most = min(reach, 0.5 * float(lengths[1]), 0.9 * float(lengths[0]))
        curve = corner[None]
        for share in (1.0, 0.5, 0.25):
            ends = [
                corner + v / n * most * share for v, n in zip((back, ahead), lengths, strict=True)
            ]
            bend = _parabola(ends[0], corner, ends[1])
            if clearance.is_path_free(bend[::4]):
                curve = bend
                break
        pieces.append(curve)
        before = curve[-1]
    return np.concatenate([*pieces, path[-1:]])


def timed(path: Joints, frame: float, haste: float = 1.0) -> Joints:
    """Joint angles at the end of each frame for a motion along a path, from rest to rest.

    The speed along the path is the largest that keeps every joint within its limits. It is found by
    forward and backward sweeps over a fine grid, with a share of the acceleration for bends and
    half of it for speeding up (a simplification of Bobrow, Dubowsky and Gibson, IJRR 1985).

    Args:
        path: polyline [K, 7], rad.
        frame: seconds per frame.
        haste: share of the speed and acceleration limits to use, in (0, 1].

    Returns:
        [N, 7]; the last row is the end of the path. A path without length takes one frame.
    """
    fine, spacing = _resampled(path)
    if spacing < _NOWHERE:
        return path[-1:]
    speed = _speeds(fine, spacing, haste * MAX_SPEED, haste * MAX_ACCELERATION)
    times = np.concatenate([[0.0], np.cumsum(2 * spacing / (speed[:-1] + speed[1:]))])
    frames = max(1, int(np.ceil(times[-1] / frame - 1e-9)))
    times *= frames * frame / times[-1]
    moments = frame * np.arange(1, frames + 1)
    motion = np.stack([np.interp(moments, times, joint) for joint in fine.T], axis=1)
    motion[-1] = path[-1]
    return motion


def _parabola(start: Joints, corner: Joints, end: Joints) -> Joints:
    """A quadratic Bézier curve, [33, 7]."""
    t = np.linspace(0, 1, 33)[:, None]
    return (1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end


def _resampled(path: Joints) -> tuple[Joints, float]:
    """Evenly spaced points along a polyline, and their spacing in rad."""
    marks = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    length = float(marks[-1])
    count = max(8, int(np.ceil(length / _SPACING)))
    along = np.linspace(0, length, count + 1)
    return np.stack([np.interp(along, marks, joint) for joint in path.T], axis=1), length / count


def _speeds(
    fine: Joints, spacing: float, max_speed: float, max_acceleration: float
) -> NDArray[np.float64]:
    """Speed along the path at every point, rad/s."""
    slope = np.gradient(fine, spacing, axis=0)
    bend = np.abs(np.gradient(slope, spacing, axis=0)).max(axis=1)
    steep = np.abs(slope).max(axis=1)
    speed = np.minimum(max_speed / steep, np.sqrt(_IN_BENDS * max_acceleration / (bend + 1e-9)))
    speed[[0, -1]] = 0.0
    gain = max_acceleration / steep * spacing  # gain of speed² per point, with half of the limit
    for k in range(1, len(speed)):
        speed[k] = min(speed[k], np.sqrt(speed[k - 1] ** 2 + gain[k]))
    for k in range(len(speed) - 2, -1, -1):
        speed[k] = min(speed[k], np.sqrt(speed[k + 1] ** 2 + gain[k]))
    return speed
