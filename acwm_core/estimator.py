"""What a video shows of a scene, what can be measured in it, and who reads it from frames.

An environment says what there is to measure (`Physics`), a `StateEstimator` reads an `Observation`
from video. Nothing here needs torch or a simulator.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_core.errors.plugin_code import WrongResultError, numbers

if TYPE_CHECKING:
    from acwm_core.shapes import Clip


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


class ViewingCamera(Protocol):
    """The camera of nominal factors, from points to frames of any size and back.

    Frame coordinates are x to the right and y down, both in heights of the frame, from its middle.
    """

    def to_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """World points `[…, 3]` in m to frame coordinates and depth in m, `[…, 3]`."""
        ...

    def from_frame(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `to_frame`."""
        ...

    def on_plane(self, seen: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        """Where rays through frame coordinates `[…, 2]` meet the plane z = `height`: `[…, 3]`."""
        ...


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
    tolerance: float = 0.0
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
        camera: that of nominal factors, for estimators which turn pixels into positions.
    """

    readings: tuple[Reading, ...] = ()
    objects: tuple[str, ...] = ()
    shapes: tuple[str, ...] = ()
    levels: tuple[Level, ...] = ()
    constants: tuple[Constant, ...] = ()
    gaps: tuple[Gap, ...] = ()
    lasting: int = 3
    unseen: float = math.inf
    camera: ViewingCamera | None = None


class StateEstimator(ABC):
    """A measuring instrument: what a video of one environment shows, without its simulator.

    It is registered under the name of the environment that it reads, and constructed with the
    environment's card, whose frame size is that of the videos. It looks at frames alone: neither
    at actions nor at the truth, and a simulated and a predicted video are read alike.

    One instance reads many clips, several at once in different threads.

    Attributes:
        card: the same.
        fields: names of the state fields that it reads.
        instances: names of the instances that its masks tell apart; pixels of the others are 0.

    Raises:
        ShapeError: the card is not that of the environment, for it lacks instances that are read.
    """

    fields: tuple[str, ...]
    instances: tuple[str, ...]

    def __init__(self, card: EnvironmentCard) -> None:
        self.card = card

    @property
    @abstractmethod
    def physics(self) -> Physics:
        """What can be measured in its observations."""

    def packages(self) -> tuple[str, ...]:
        """Packages whose files decide what it reads: caches of scores go by their hash."""
        return (type(self).__module__.partition(".")[0],)

    def provenance(self) -> Mapping[str, str]:
        """What its readings depend on, e.g. the hash of the weights of a network."""
        return {}

    @abstractmethod
    def estimate(self, video: Clip) -> Observation:
        """Masks of `instances` and the states `fields` of a video.

        Args:
            video: `[T, 3, H, W]` float in [0, 1], H and W as on the card.

        Raises:
            ShapeError: frames of another size.
        """

    def read(self, video: Clip) -> Observation:
        """What `estimate` gives; `WrongResultError` if it is no observation of these frames."""
        seen: Any = self.estimate(video)
        frames, _, *size = video.shape
        if not isinstance(seen, Observation) or set(self.fields) - set(seen.states):
            raise WrongResultError(self, "estimate", seen, f"an Observation of {self.fields}")
        masks = numbers(self, "estimate (masks)", seen.masks, frames, *size, dtype=np.uint8)
        states = {**seen.states}
        for field in (each for each in self.card.state if each.name in self.fields):
            method, shape = f"estimate ({field.name})", (frames, *field.shape)
            states[field.name] = found = numbers(self, method, states[field.name], *shape)
            if np.isinf(found).any():
                raise WrongResultError(self, method, math.inf, "finite numbers, or NaN")
        return Observation(masks, states)

    @abstractmethod
    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """Where positions appear in a frame, of estimates and of the truth alike.

        Args:
            field: a field of `fields` that holds positions or points of a curve.
            values: `[…, D]` in m, as on the card.

        Returns:
            `[…, 2]`: x to the right and y down, in pixels of a frame of the card's size, from its
            upper left corner.
        """
