"""State estimation from video: what can be measured in a scene, and the estimator interface.

An environment declares what can be measured (`Physics`); a `StateEstimator` reads an `Observation`
from video. Nothing here needs torch or a simulator.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.state_field import SYMMETRIES, BodySymmetry, StateField
from acwm_core.errors import PluginError, ShapeError, check_shape

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


@dataclass(frozen=True)
class Observation:
    """What can be seen in a video of T frames.

    The simulator's own masks and states form an observation as well, so everything that is measured
    in an estimated observation can also be measured in the ground truth.

    Attributes:
        masks: `[T, H, W]` uint8 instance ids, as on the environment's card.
        states: some of the card's state fields under their own names, shapes and units, each
            `[T, …]`; NaN where a value cannot be seen.
    """

    masks: NDArray[np.uint8]
    states: Mapping[str, NDArray[Any]]


States = Mapping[str, NDArray[Any]]
"""The simulator's states in the first frame of a clip, by field, without a time axis."""

Measure = Callable[[Observation, States], NDArray[np.float64]]
"""Measures each frame of an observation: `[T]`, or `[T, n]` for a `Level`; NaN where unknown.

The states of the first frame, which every model is given, hold what never changes and need not be
estimated, e.g. the sizes of bodies and the positions of fixtures.
"""


ReadingKind = Literal["position", "curve", "angle", "quaternion"]
"""Kinds of state fields that can be read from video and compared."""


@dataclass(frozen=True)
class Reading:
    """A state field with positions or orientations of bodies; see `readings_of`.

    Attributes:
        field: its name on the card.
        kind: ``position`` in m, the last axis x, y(, z); ``curve``, the points of one long body
            from either end to the other; ``angle`` in rad; ``quaternion`` (w, x, y, z).
        instances: name of the instance that each row of the field belongs to; one name for a
            field without rows and for a curve.
        symmetry: symmetry of the bodies; angles and quaternions are compared up to its rotations.
        present: the state field that is 1 for rows that exist; empty if all do.
        columns: which entries of the last axis to use; empty for all.
    """

    field: str
    kind: ReadingKind
    instances: tuple[str, ...]
    symmetry: BodySymmetry = "none"
    present: str = ""
    columns: tuple[int, ...] = ()

    def of(self, states: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
        """Select its values `[T, …]` from the states of an observation or of the simulator."""
        values = np.asarray(states[self.field], np.float64)
        return values[..., list(self.columns)] if self.columns else values


def readings_of(state: Iterable[StateField], *names: str) -> tuple[Reading, ...]:
    """The positions and orientations in some fields of the state, as the card declares them.

    Args:
        state: the fields of the card.
        names: of those that are read.

    Raises:
        ShapeError: a field is not there, or has nothing that can be read.
    """
    fields, readings = {field.name: field for field in state}, list[Reading]()
    for name in names:
        field, kinds = fields.get(name), get_args(ReadingKind)
        parts = [part for part in field.parts if part.kind in kinds] if field else []
        if field is None or not parts or not field.instances:
            raise ShapeError(
                f"{name!r} cannot be read: declare it as one of {', '.join(kinds)} and name its "
                "instances"
            )
        owners = field.instances if field.grid else field.owners
        readings += [
            Reading(
                name,
                cast(ReadingKind, part.kind),
                owners,
                field.symmetry if part.kind in SYMMETRIES else "none",
                field.present,
                part.columns,
            )
            for part in parts
        ]
    return tuple(readings)


@dataclass(frozen=True)
class Constant:
    """A conserved quantity.

    Attributes:
        name: e.g. ``"length of the forearm"``.
        kind: ``length``, of a link or a rope, or ``amount``, of water or sand.
        measure: measures it, in any unit; only relative changes count.
        tolerance: largest relative change that is attributed to estimation errors.
        lasting: number of consecutive frames that a change must last to count as real.
    """

    name: str
    kind: Literal["length", "amount"]
    measure: Measure
    tolerance: float = 0.0
    lasting: int = 3


@dataclass(frozen=True)
class Level:
    """The surface height of something without a pose, such as sand or water.

    Attributes:
        name: e.g. ``"water in the container"``.
        measure: heights in m at n places, `[T, n]`; NaN where unknown.
    """

    name: str
    measure: Measure


@dataclass(frozen=True)
class Gap:
    """The distance between two bodies.

    Attributes:
        name: name of the kind of pair, e.g. ``"pusher-cube"``; pairs of a kind share thresholds.
        pair: names of their instances.
        measure: distance between their surfaces in m; if they overlap, minus the overlap depth.
            For a fluid in a vessel, minus the depth of the fluid.
        touch: distance in m below which bodies count as touching; None if touch cannot be inferred
            from distance.
        solid: overlap in m above which the bodies cannot be real; None for bodies that may pass
            through each other.
    """

    name: str
    pair: tuple[str, str]
    measure: Measure
    touch: float | None = None
    solid: float | None = None


@dataclass(frozen=True)
class Physics:
    """What the physics metrics need to know about an environment.

    Attributes:
        readings: positions and orientations of bodies.
        objects: instances that are one piece each, and neither appear nor disappear.
        shapes: instances that have a shape instead of a pose: rope, cloth, sand, water.
        levels: surface heights, e.g. of sand or water.
        constants: conserved quantities.
        gaps: distances of bodies that may touch.
        lasting: number of consecutive frames for which an object must be missing, split or one too
            many before it counts as real.
        unseen: number of consecutive frames for which an object may be out of sight, whatever
            hides it.
        camera: that of the environment's card, for estimators that turn pixels into positions.
        state: the fields of the card, for estimators that read some.
    """

    readings: tuple[Reading, ...] = ()
    objects: tuple[str, ...] = ()
    shapes: tuple[str, ...] = ()
    levels: tuple[Level, ...] = ()
    constants: tuple[Constant, ...] = ()
    gaps: tuple[Gap, ...] = ()
    lasting: int = 3
    unseen: float = math.inf
    camera: Camera | None = None
    state: tuple[StateField, ...] = ()

    @property
    def fields(self) -> dict[str, StateField]:
        """The fields of the card by their names."""
        return {field.name: field for field in self.state}

    @property
    def positions(self) -> list[Reading]:
        """The readings that are positions in m, of bodies and of the points of curves."""
        return [reading for reading in self.readings if reading.kind in ("position", "curve")]


class StateEstimator(ABC):
    """Estimates masks and states from videos of one environment, without its simulator.

    It is registered under the name of its environment, and constructed with the environment's card,
    whose frame size is that of the videos. It sees only frames, neither actions nor ground truth,
    and treats simulated and predicted videos in the same way.

    One instance reads many clips, possibly several at once in different threads.

    Args:
        card: the environment's card.

    Attributes:
        card: the same.
        fields: names of the state fields that it reads.
        instances: names of the instances that its masks contain; all other pixels are 0.

    Raises:
        ShapeError: the card is not that of the environment: it lacks instances that are read.
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
        """Packages whose code determines its estimates; caches of scores depend on their hash."""
        return (type(self).__module__.partition(".")[0],)

    def provenance(self) -> Mapping[str, str]:
        """What else its estimates depend on, e.g. the hash of a network's weights."""
        return {}

    @abstractmethod
    def estimate(self, video: Float[Tensor, "T 3 H W"]) -> Observation:
        """Estimate the masks of `instances` and the states `fields` of a video.

        Args:
            video: `[T, 3, H, W]` float in [0, 1], with H and W as on the card.

        Raises:
            ShapeError: the frames have another size.
        """

    def read(self, video: Float[Tensor, "T 3 H W"]) -> Observation:
        """Call `estimate` and check its result; `PluginError` if it does not fit the video."""
        seen: Any = self.estimate(video)
        frames, _, *size = video.shape
        if not isinstance(seen, Observation) or set(self.fields) - set(seen.states):
            owner = type(self).__name__
            raise PluginError(f"{owner}.estimate gives no Observation of {', '.join(self.fields)}")
        check_shape(self, "estimate (masks)", seen.masks, frames, *size)
        for field in self.card.state:
            if field.name not in self.fields:
                continue
            method = f"estimate ({field.name})"
            check_shape(self, method, seen.states[field.name], frames, *field.shape)
            if np.isinf(seen.states[field.name]).any():
                owner = type(self).__name__
                raise PluginError(f"{owner}.{method} is infinite: give finite numbers, or NaN")
        return seen

    @abstractmethod
    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """Project positions, estimated or true, to pixels.

        Args:
            field: one of `fields`, with positions or points of a curve.
            values: `[…, D]` in m, as on the card.

        Returns:
            `[…, 2]`: x to the right and y down from the upper left corner, in pixels of a frame of
            the card's size.
        """
