"""Where the Panda's hand is for given joint angles, and joint angles that bring it somewhere.

Denavit–Hartenberg parameters in Craig's convention, as Franka publishes them.
"""

import numpy as np
from numpy.typing import NDArray

_A = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
_D = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])
_TWISTS = (0, -1, 1, 1, -1, 1, 1)  # quarter turns about x
_COS, _SIN = [int(k == 0) for k in _TWISTS], list(_TWISTS)
_OFFSETS = np.array([_A, -np.array(_SIN) * _D, np.array(_COS) * _D]).T
_GRASP = 0.107 + 0.105  # metres from the last joint over the flange to between the fingertips
_HALF = np.sqrt(0.5)
_HAND = np.array([[_HALF, _HALF, 0.0], [-_HALF, _HALF, 0.0], [0.0, 0.0, 1.0]])  # −45° about z

_DAMPING = 1e-4  # keeps steps short near singular poses
_PULL = 0.15  # share of the way to the rest pose that the first step takes, if the hand stays
_LONGEST = 0.3  # radians per step
_STEPS, _ENOUGH = 30, 1e-5  # at most; metres and radians that may be missing


def forward(joints: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Position [3] and rotation [3, 3] of the grasping point, and its Jacobian [6, 7].

    The Jacobian's rows are the velocity and the angular velocity, in the world.
    """
    sines, cosines = np.sin(joints).tolist(), np.cos(joints).tolist()
    place, turn = np.zeros(3), np.eye(3)
    places, axes = np.empty((7, 3)), np.empty((7, 3))
    for k in range(7):
        s, c, sa, ca = sines[k], cosines[k], _SIN[k], _COS[k]
        place = place + turn @ _OFFSETS[k]
        turn = turn @ np.array([[c, -s, 0.0], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]])
        places[k], axes[k] = place, turn[:, 2]
    place = place + _GRASP * turn[:, 2]
    return place, turn @ _HAND, np.vstack([_cross(axes, place - places).T, axes.T])


def inverse(
    position: NDArray,
    rotation: NDArray,
    start: NDArray,
    limits: tuple[NDArray, NDArray],
    rest: NDArray,
) -> NDArray[np.float64]:
    """Joint angles [7] near `start` that bring the hand there, or as near as their limits allow.

    Damped least squares (Wampler 1986); what freedom is left draws the arm towards `rest`.

    Args:
        position: [3], metres.
        rotation: [3, 3].
        start: [7], radians.
        limits: least and greatest angles.
        rest: [7].
    """
    joints = np.asarray(start, np.float64)
    for number in range(_STEPS):
        place, turn, jacobian = forward(joints)
        turning = 0.5 * _cross(turn.T, rotation.T).sum(0)
        missing = np.concatenate([position - place, turning])
        if np.abs(missing).max() < _ENOUGH:
            break
        square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
        back = (rest - joints) * (_PULL if number == 0 else 0.0)
        step = back + jacobian.T @ np.linalg.solve(square, missing - jacobian @ back)
        step *= min(1.0, _LONGEST / np.abs(step).max())
        joints = np.clip(joints + step, *limits)
    return joints


def _cross(a: NDArray, b: NDArray) -> NDArray:
    """Cross products of rows [N, 3]; NumPy's own is several times slower for so few."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
