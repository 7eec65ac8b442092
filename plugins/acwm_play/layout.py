"""Assigns keys, sticks and sliders to actions, from the names and units in a card.

Arrow keys should move things in the direction of the arrow, so the world's camera determines which
action moves to the right and which moves up. If actions are absolute places in the plane, the
person points at the picture instead: `Pointing` converts places in the picture to actions and back.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import Physics
from acwm_core.plugins import catalog
from acwm_play.simulator import SceneSpec, Simulator

KEYS = (
    *(("ArrowLeft", "ArrowRight"), ("ArrowDown", "ArrowUp"), ("KeyA", "KeyD"), ("KeyS", "KeyW")),
    *(("KeyQ", "KeyE"), ("KeyF", "KeyR"), ("KeyG", "KeyT"), ("KeyH", "KeyY")),
)
"""Pairs of keys (for a lower and a higher value), in the order in which dimensions get them."""

AXES: dict[str, tuple[float, float, float]] = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}

SAMPLES = 5
"""Number of scenes from which the map between places and actions is fitted."""

TOLERANCE = 1e-3
"""Largest error of that fit, in units of actions."""


def physics_of(environment: str) -> Physics | None:
    """The physics of a world, which says what can be measured; None if it has none."""
    if environment not in catalog().registry("environment"):  # it is recorded
        return None
    component = catalog().component("environment", environment)
    if component.physics is None:
        return None
    try:
        physics = component.load_physics()
    except Exception:  # whatever a plugin raises as it is imported
        return None
    return physics if isinstance(physics, Physics) else None


def controls(card: EnvironmentCard, physics: Physics | None) -> list[dict[str, Any]]:
    """Describe each action dimension for the page, in order.

    Returns:
        Dicts with `name`, `label`, `unit`, `low`, `high`, `holds` (whether the value stays when the
        control is released), `keys` (for less and for more), `sign` (−1 where more means left or
        down) and `place` (position in the order of keys).
    """
    action, signs = card.action, dict.fromkeys(range(card.action.size), 1)
    order: list[int] = []
    for k in (0, 1):  # the dimension that moves right, then the one that moves up
        best = _along(card, physics, k, order)
        if best is not None:
            order.append(best[0])
            signs[best[0]] = best[1]
        else:
            order += [i for i in range(action.size) if i not in order][:1]
    order += [i for i in range(action.size) if i not in order]
    descriptions: list[dict[str, Any]] = []
    for i, name in enumerate(action.names):
        place = order.index(i)
        setting = not action.units[i] and (action.low[i], action.high[i]) == (-1.0, 1.0)
        descriptions.append(
            {
                "name": name,
                "label": name.replace("_", " "),
                "unit": action.units[i],
                "low": action.low[i],
                "high": action.high[i],
                "holds": action.kind == "absolute" or setting,
                "keys": KEYS[place] if place < len(KEYS) else None,
                "sign": signs[i],
                "place": place,
            }
        )
    return descriptions


def _along(
    card: EnvironmentCard, physics: Physics | None, axis: int, order: list[int]
) -> tuple[int, int] | None:
    """The dimension that moves most along right (0) or up (1) in the picture, and its sign."""
    if physics is None or physics.camera is None:
        return None
    best, dimension = 0.0, None
    for i, name in enumerate(card.action.names):
        letters = re.findall(r"(?:^|_)d?([xyz])(?:_|$)", name)
        if i in order or len(letters) != 1:
            continue
        step = 0.01 * np.array([np.zeros(3), AXES[letters[0]]])
        origin, target = physics.camera.to_frame(step)[:, :2]
        way = float((target - origin)[axis]) * (1, -1)[axis]  # y is down in pictures
        if abs(way) > 1.02 * best:
            best, dimension = abs(way), (i, 1 if way > 0 else -1)
    return dimension if best > 1e-4 else None


class Pointing:
    """The map between places in the picture and absolute actions.

    Places are `[P, 2]`, x to the right and y down, both from 0 to 1 over the picture. There is one
    place for every two dimensions of the action.

    Args:
        physics: physics of the world, with its camera and bodies.
        aspect: width of frames divided by their height.
        maps: one `[3, 2]` matrix per place, from (x, y, 1) in m to two dimensions of the action.
    """

    def __init__(self, physics: Physics, aspect: float, maps: NDArray[np.float64]) -> None:
        assert physics.camera is not None
        self._camera, self._aspect, self._maps = physics.camera, aspect, maps

    @classmethod
    def fit(cls, simulator: Simulator, physics: Physics | None) -> Pointing | None:
        """Fit the map: for absolute actions, the simulator's `still_action` says where things are.

        It is compared with the positions of the bodies in a few scenes. None if the actions are not
        places in the plane.
        """
        action = simulator.card.action
        if action.kind != "absolute" or action.size % 2 or physics is None or not physics.camera:
            return None
        still_actions: list[NDArray[np.float64]] = []
        bodies: list[NDArray[np.float64]] = []
        for index in range(SAMPLES):
            time_step = simulator.start(SceneSpec(index))[0]
            still_actions.append(np.asarray(simulator.still(), np.float64))
            rows = [r.of(time_step.state) for r in physics.readings if r.kind == "position"]
            bodies.append(np.concatenate([r.reshape(-1, r.shape[-1])[:, :2] for r in rows]))
        maps = [
            _fit_map(np.stack(bodies, 1), np.stack(still_actions)[:, i : i + 2])
            for i in range(0, action.size, 2)
        ]
        if any(fit is None for fit in maps):
            return None
        height, width = simulator.card.frame_size
        return cls(physics, width / height, np.stack([m for m in maps if m is not None]))

    def action(self, places: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action `[2P]` for places; it may be out of its bounds."""
        offsets = (places - 0.5) * [self._aspect, 1.0]
        ground = self._camera.on_plane(offsets, 0.0)[:, :2]
        rows = [_with_one(g) @ m for g, m in zip(ground, self._maps, strict=True)]
        return np.concatenate(rows).astype(np.float32)

    def places(self, action: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """The inverse of `action`."""
        pairs = np.asarray(action, np.float64).reshape(-1, 2)
        ground = np.zeros((len(pairs), 3))
        for k, (row, fit) in enumerate(zip(pairs, self._maps, strict=True)):
            ground[k, :2] = np.linalg.solve(fit[:2].T, row - fit[2])
        return self._camera.to_frame(ground)[:, :2] / [self._aspect, 1.0] + 0.5


def _with_one(point: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.append(point, 1.0)


def _fit_map(
    bodies: NDArray[np.float64], still_actions: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The affine map from that one of several bodies that explains two action dimensions."""
    for body in bodies:
        known = np.column_stack([body, np.ones(len(body))])
        solution, _, rank, _ = np.linalg.lstsq(known, still_actions, rcond=None)
        if rank == 3 and np.abs(known @ solution - still_actions).max() < TOLERANCE:
            return np.asarray(solution, np.float64)
    return None
