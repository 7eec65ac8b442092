"""The initial layout of the sand: loosely poured grains, which settle later."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

GRAINS, DOUBLED = 3000, 6000
"""Number of grains in training, and out of distribution."""

LAYOUTS = ("slab", "heap", "twins", "ridge")
"""Kinds of layouts: a wide slab, a round heap, two heaps, a long narrow ridge."""

LOOSENESS = 1.14
"""Spacing of the grains before they settle, in diameters."""

_ROOM = np.array([0.40, 0.27])  # half sizes in metres of the area in which sand is poured

Footprint = Callable[[NDArray[np.float64]], NDArray[np.bool_]]


def pour(count: int, radius: float, layout: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Loose grains above the ground, in random order, [count, 3] metres.

    Each layer is a square grid with a random shift and rotation, so that no lattice is left once
    the grains have settled.

    Args:
        count: number of grains.
        radius: radius of a grain in metres.
        layout: one of `LAYOUTS`.
        rng: draws the position, size and angle of the footprint, and the grids.
    """
    covers = _footprint(layout, count * (2 * radius) ** 3, rng)
    layers: list[NDArray[np.float64]] = []
    placed, z = 0, radius
    while placed < count:
        flat = _layer(radius, rng)
        flat = flat[covers(flat)]
        lift = rng.uniform(0, 0.3 * radius, len(flat))
        layers.append(np.column_stack([flat, z + lift]))
        placed, z = placed + len(flat), z + 2.1 * radius
    grains = np.concatenate(layers)[:count]
    return grains[rng.permutation(count)]


def _layer(radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    spacing = 2 * radius * LOOSENESS
    steps = np.arange(-np.hypot(*_ROOM) - spacing, np.hypot(*_ROOM) + spacing, spacing)
    points = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + rng.uniform(0, spacing, 2)
    angle = rng.uniform(0, np.pi / 2)
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]]) + rng.normal(0, 0.08 * radius, points.shape)


def _footprint(layout: str, volume: float, rng: np.random.Generator) -> Footprint:
    """A function that tells which points [P, 2] the sand covers; wide enough for a low layer."""
    angle, area = rng.uniform(0, np.pi), volume ** (2 / 3) * rng.uniform(2.7, 3.3)
    aspect = {"slab": rng.uniform(1.0, 1.7), "ridge": rng.uniform(3.0, 4.0)}.get(layout, 1.0)
    half = np.sqrt(area * np.array([aspect, 1 / aspect])) / 2
    reach = min(1.0, *(_ROOM / np.hypot(*half)) * 1.15)
    middle = rng.uniform(-1, 1, 2) * np.maximum(_ROOM - half.max() * 1.15, 0.0)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])

    def covers(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        local = (points - middle) @ turn / (half * max(reach, 0.85))
        if layout == "heap":
            return np.hypot(*local.T) < 1.12
        if layout == "twins":
            aside = np.array([0.75, 0.0])
            left, right = local - aside, local + aside
            return np.minimum(np.hypot(*left.T), np.hypot(*right.T)) < 0.72
        return np.abs(local).max(1) < 1

    return covers
