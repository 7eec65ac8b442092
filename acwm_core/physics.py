"""What can be measured in the things that a video shows: an `Observation` and its `Physics`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Observation:
    """What a video of T frames shows.

    The simulator's own masks and states make one as well; so everything that is measured in an
    observation can be measured in the truth.

    Attributes:
        masks: `[T, H, W]` uint8 instance ids, as on the environment's card.
        states: some of the card's state fields under their own names, shapes and units, each
            `[T, …]`; NaN where nothing of it is seen.
    """

    masks: NDArray[np.uint8]
    states: Mapping[str, NDArray[Any]]


States = Mapping[str, NDArray[Any]]
"""The simulator's states in the first frame of a clip, by field, without an axis of time."""

Measure = Callable[[Observation, States], NDArray[np.float64]]
"""Measures each frame of an observation, `[T]`, a `Level` `[T, n]`; NaN where it cannot be told.

The states of the first frame, which every model is given, say what does not change and need not be
read: the sizes of bodies, and where fixtures stand.
"""

Symmetry = Literal["none", "half_turn", "quarter_turn", "box", "cube"]
"""Turns after which a body looks the same:

* ``half_turn``, ``quarter_turn``: of an angle, by π or π/2.
* ``box``, ``cube``: of a quaternion, the 4 rotations of a box or the 24 of a cube.
"""


@dataclass(frozen=True)
class Reading:
    """A state field that says where bodies are or how they lie.

    Attributes:
        field: its name on the card.
        kind: ``position`` in m, the last axis x, y(, z); ``curve``, the points of one long body
            from either end to the other; ``angle`` in rad; ``quaternion`` (w, x, y, z).
        instances: name of the instance that each row of the field belongs to; one name for a
            field without rows and for a curve.
        symmetry: of the bodies; an angle or quaternion counts up to these turns.
        present: the state field that is 1 for rows that exist; empty if all do.
        columns: which entries of the last axis; empty takes them all.
    """

    field: str
    kind: Literal["position", "curve", "angle", "quaternion"]
    instances: tuple[str, ...]
    symmetry: Symmetry = "none"
    present: str = ""
    columns: tuple[int, ...] = ()

    def of(self, states: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
        """What it reads, from all that an observation or the simulator holds: `[T, …]`."""
        values = np.asarray(states[self.field], np.float64)
        return values[..., list(self.columns)] if self.columns else values


@dataclass(frozen=True)
class Constant:
    """A quantity that stays as it is whatever happens.

    Attributes:
        name: e.g. ``"length of the forearm"``.
        kind: ``length``, of a link or a rope, or ``amount``, of water or sand.
        measure: in any unit; changes are relative.
        tolerance: largest relative change that is put down to the estimator.
        lasting: frames in a row for which a change must last before it is taken for real.
    """

    name: str
    kind: Literal["length", "amount"]
    measure: Measure
    tolerance: float
    lasting: int = 3


@dataclass(frozen=True)
class Level:
    """How high something stands that has no pose, such as sand or water.

    Attributes:
        name: e.g. ``"water in the container"``.
        measure: heights in m, at as many places as there are: `[T, n]`; NaN where none can be told.
    """

    name: str
    measure: Measure


@dataclass(frozen=True)
class Gap:
    """How far two bodies are apart.

    Attributes:
        name: of the kind of pair, e.g. ``"pusher-cube"``; pairs of a kind share their thresholds.
        pair: names of their instances.
        measure: distance of their surfaces in m, negative by how deep they overlap; for a fluid in
            a vessel, minus how deep it stands there.
        touch: bodies that are nearer than this count as touching, m; None where it cannot be told
            from a distance.
        solid: bodies that overlap by more than this cannot be real, m; None for bodies that may
            pass through each other.
    """

    name: str
    pair: tuple[str, str]
    measure: Measure
    touch: float | None = None
    solid: float | None = None


@dataclass(frozen=True)
class Physics:
    """What the metrics of physics need to know of an environment.

    Attributes:
        readings: where bodies are and how they lie.
        objects: instances that are one piece each, and neither come nor go.
        shapes: instances that have a shape instead of a pose: rope, cloth, sand, water.
        levels: how high it stands.
        constants: what is conserved.
        gaps: which bodies meet.
        lasting: frames in a row for which objects must be missing, split or one too many before it
            is taken for real.
        unseen: frames in a row for which an object may be out of sight, whatever hides it.
    """

    readings: tuple[Reading, ...] = ()
    objects: tuple[str, ...] = ()
    shapes: tuple[str, ...] = ()
    levels: tuple[Level, ...] = ()
    constants: tuple[Constant, ...] = ()
    gaps: tuple[Gap, ...] = ()
    lasting: int = 3
    unseen: float = math.inf
