"""Which keys, sticks and sliders move what: derived from the names and units of a card's actions.

Arrow keys should move things the way that they point, so the camera of a world says which action
goes to the right and which one up. Where actions are absolute places in the plane, the person
points at the picture instead: `Pointing` turns places in the picture into actions and back.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.catalog import catalog
from acwm_core.environment import EnvironmentCard
from acwm_core.errors import AcwmError
from acwm_core.estimator import Physics
from acwm_play.simulator import Scene, Simulator

KEYS = (
    *(("ArrowLeft", "ArrowRight"), ("ArrowDown", "ArrowUp"), ("KeyA", "KeyD"), ("KeyS", "KeyW")),
    *(("KeyQ", "KeyE"), ("KeyF", "KeyR"), ("KeyG", "KeyT"), ("KeyH", "KeyY")),
)
"""Pairs of keys, the lower value first, in the order in which dimensions get them."""

AXES: dict[str, tuple[float, float, float]] = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}

SAMPLES = 5
"""Scenes from which the map between places and actions is found."""

TOLERANCE = 1e-3
"""How well it must fit, in units of actions."""


def physics_of(environment: str) -> Physics | None:
    """What can be measured in a world; None if it does not say."""
    component = catalog().component("environment", environment)
    if component.physics is None:
        return None
    try:
        physics = component.load_physics()
    except AcwmError:
        return None
    return physics if isinstance(physics, Physics) else None


def controls(card: EnvironmentCard, physics: Physics | None) -> list[dict[str, Any]]:
    """A description of each action dimension for the page, in their order.

    Returns:
        Dicts of `name`, `label`, `unit`, `low`, `high`, `holds` (the value stays when it is let go
        of), `keys` (for less and for more) and `sign` (−1 where more is to the left, or down).
    """
    action, signs = card.action, dict.fromkeys(range(card.action.size), 1)
    order: list[int] = []
    for k in (0, 1):  # what goes right, then what goes up
        best = _along(card, physics, k, order)
        if best is not None:
            order.append(best[0])
            signs[best[0]] = best[1]
        else:
            order += [i for i in range(action.size) if i not in order][:1]
    order += [i for i in range(action.size) if i not in order]
    described: list[dict[str, Any]] = []
    for i, name in enumerate(action.names):
        place = order.index(i)
        setting = not action.units[i] and (action.low[i], action.high[i]) == (-1.0, 1.0)
        described.append(
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
    return described


def _along(
    card: EnvironmentCard, physics: Physics | None, axis: int, taken: list[int]
) -> tuple[int, int] | None:
    """The dimension that moves most to the right (0) or up (1) in the picture, and its sign."""
    if physics is None or physics.camera is None:
        return None
    best, found = 0.0, None
    for i, name in enumerate(card.action.names):
        letters = re.findall(r"(?:^|_)d?([xyz])(?:_|$)", name)
        if i in taken or len(letters) != 1:
            continue
        step = 0.01 * np.array([np.zeros(3), AXES[letters[0]]])
        here, there = physics.camera.to_frame(step)[:, :2]
        way = float((there - here)[axis]) * (1, -1)[axis]  # y is down in pictures
        if abs(way) > 1.02 * best:
            best, found = abs(way), (i, 1 if way > 0 else -1)
    return found if best > 1e-4 else None


class Pointing:
    """The map between places in the picture and absolute actions.

    Places are `[P, 2]`, x to the right and y down, both from 0 to 1 over the picture; a place for
    every two dimensions of the action.

    Args:
        physics: has the camera and says which bodies there are.
        aspect: width of frames over their height.
        maps: for each place a `[3, 2]` matrix from (x, y, 1) in m to two dimensions of the action.
    """

    def __init__(self, physics: Physics, aspect: float, maps: NDArray[np.float64]) -> None:
        assert physics.camera is not None
        self._camera, self._aspect, self._maps = physics.camera, aspect, maps

    @classmethod
    def found(cls, simulator: Simulator, physics: Physics | None) -> Pointing | None:
        """Ask the simulator: `still_action` of an absolute action says where things are.

        It is compared with where the bodies of the card are in a few scenes. None where actions are
        no places in the plane.
        """
        action, given = simulator.card.action, simulator.environment
        if action.kind != "absolute" or action.size % 2 or physics is None or not physics.camera:
            return None
        stills: list[NDArray[np.float64]] = []
        bodies: list[NDArray[np.float64]] = []
        for index in range(SAMPLES):
            moment = simulator.start(Scene(index))[0]
            stills.append(np.asarray(given.still_action(), np.float64))
            rows = [r.of(moment.state) for r in physics.readings if r.kind == "position"]
            bodies.append(np.concatenate([r.reshape(-1, r.shape[-1])[:, :2] for r in rows]))
        maps = [
            _fitted(np.stack(bodies, 1), np.stack(stills)[:, i : i + 2])
            for i in range(0, action.size, 2)
        ]
        if any(each is None for each in maps):
            return None
        height, width = simulator.card.frame_size
        return cls(physics, width / height, np.stack([m for m in maps if m is not None]))

    def action(self, places: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action `[2P]` that stands for places; it may be out of its bounds."""
        seen = (places - 0.5) * [self._aspect, 1.0]
        ground = self._camera.on_plane(seen, 0.0)[:, :2]
        rows = [_with_one(g) @ m for g, m in zip(ground, self._maps, strict=True)]
        return np.concatenate(rows).astype(np.float32)

    def places(self, action: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """The inverse of `action`."""
        wanted = np.asarray(action, np.float64).reshape(-1, 2)
        ground = np.zeros((len(wanted), 3))
        for k, (row, each) in enumerate(zip(wanted, self._maps, strict=True)):
            ground[k, :2] = np.linalg.solve(each[:2].T, row - each[2])
        return self._camera.to_frame(ground)[:, :2] / [self._aspect, 1.0] + 0.5


def _with_one(point: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.append(point, 1.0)


def _fitted(bodies: NDArray[np.float64], stills: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The affine map from the body `[samples, 2]` among many that explains two dimensions."""
    for body in bodies:
        known = np.column_stack([body, np.ones(len(body))])
        solved, _, rank, _ = np.linalg.lstsq(known, stills, rcond=None)
        if rank == 3 and np.abs(known @ solved - stills).max() < TOLERANCE:
            return np.asarray(solved, np.float64)
    return None
