"""The physics of pour_water: water in a moving cup, and in a container on a table."""

import numpy as np
from numpy.typing import NDArray

from acwm_particle.cup import THICKNESS, Cup, tilted
from acwm_particle.kernels.neighbors import pack_grid
from acwm_particle.kernels.water_step import water_step
from acwm_particle.physics import SPACING
from acwm_sim import engine

FRAME = 0.1
"""Duration of a frame in seconds."""

RADIUS = SPACING / 2
"""Least distance in metres of a particle's centre from a wall."""

REACH = 1.65 * SPACING
"""Radius of the kernels in metres."""

SUBSTEPS, PER_SEARCH = 15, 5
"""Substeps per frame, and substeps between two searches for neighbours."""

_SETTLING = 8  # frames in which newly placed water comes to rest
_MARGIN = 1.06  # factor on the search distance, as neighbours move until the next search
_MAX_NEIGHBORS = 60


def _alone() -> float:
    """The density of a lone particle relative to that of a cubic lattice (poly6 kernel)."""
    steps = np.arange(-3, 4) * (SPACING / REACH)
    squares = (np.stack(np.meshgrid(steps, steps, steps), -1) ** 2).sum(-1)
    return float(1 / np.where(squares < 1, (1 - squares) ** 3, 0).sum())


ALONE = _alone()


def count_for(level: float, inner: float) -> int:
    """Number of particles that fill a vessel with this inner radius to `level` (metres)."""
    return max(1, round(np.pi * inner**2 * level / SPACING**3))


class Water:
    """Particles of water, initially in a cup.

    Args:
        cup: the cup, upright and at rest, and the container.
        level: initial level of the water in the cup, metres.
        viscosity: rate at which neighbours take on each other's velocity, 1/s.
        rng: shakes the particles before they settle.

    Attributes:
        velocities: [N, 3] float32, m/s, in the order of `particles`.
        density: [N] float32, relative to rest, in the order of `particles`.
        cup: the cup.
        level: initial level of the water in the cup, metres.
        touches: whether water touched cup, container and table in the last frame.
    """

    def __init__(self, cup: Cup, level: float, viscosity: float, rng: np.random.Generator) -> None:
        engine.start()
        self.cup, self.level, self._viscosity = cup, level, viscosity
        self._x = _loose(cup, level, rng)
        count = len(self._x)
        self.number = np.arange(count, dtype=np.int32)
        self.velocities, self._last = np.zeros_like(self._x), np.zeros_like(self._x)
        self._mix = np.zeros((count, 7), np.float32)
        self.density = np.ones(count, np.float32)
        self._near = np.zeros((count, _MAX_NEIGHBORS + 1), np.int32)
        self._grid, cells = pack_grid([-2.6, -1.6, 0], [2.4, 1.6, 3.2], REACH * _MARGIN)
        self._start, self._bins = np.zeros(cells + 1, np.int32), np.zeros(130, np.int32)
        self._rows, self._order = np.zeros(count, np.int32), np.zeros(count, np.int32)
        shapes = (cup.shape, cup.container)
        self._sizes = np.array([[v.inner, THICKNESS, v.tall] for v in shapes], np.float32)
        self._hit = np.zeros(3, np.int32)
        self.touches = (True, False, False)

    @property
    def particles(self) -> NDArray[np.float32]:
        """[N, 3] centres in metres; rows are reordered from frame to frame, see `number`."""
        return self._x

    @property
    def numbered(self) -> NDArray[np.float32]:
        """[N, 3] centres in metres, with each particle always in the same row."""
        rows = np.empty_like(self._x)
        rows[self.number] = self._x
        return rows

    def settle(self, frames: int) -> None:
        """Let the water come to rest in the still cup."""
        path = np.tile(self.cup.pose, (SUBSTEPS + 1, 1))
        for frame in range(frames):
            self._step(path, max(self._viscosity, 12.0))
            self.velocities *= 0.2 if frame < frames - 2 else 0.7

    def fill_container(self, share: float, rng: np.random.Generator) -> None:
        """Move the upper `share` of the water in the cup to the container, at rest in both."""
        count = round(share * len(self._x))
        rows = np.argsort(self._x[:, 2])[len(self._x) - count :]
        poured = _layers(count, self.cup.container.inner, rng)
        self._x[rows] = poured + np.array([*self.cup.place, THICKNESS])
        self.velocities[:] = 0
        self.settle(_SETTLING)

    def displace(self, shift: NDArray[np.float64]) -> bool:
        """Move the cup and its water by `shift` ([4], metres and radians of tilt).

        No time passes. Nothing moves if the container or the table is in the way.

        Returns:
            Whether it moved.
        """
        cup, pose = self.cup, self.cup.pose + shift
        if np.any(cup.free(pose) != pose):
            return False
        held = (self._x - cup.pose[:3]) @ tilted(float(cup.pose[3]))
        self._x[:] = held @ tilted(float(pose[3])).T + pose[:3]
        cup.pose, cup.target = pose, pose.copy()
        return True

    def advance(self, action: NDArray[np.float64]) -> None:
        """Simulate a frame in which the cup's target moves by `action` [4]; see `PourWater`."""
        self._step(self.cup.advance(action, FRAME, SUBSTEPS), self._viscosity)

    def shares(self) -> NDArray[np.float64]:
        """[3] shares of the water in the cup, in the container, and spilt on the table."""
        cup = self.cup
        local = (self._x - cup.pose[:3]) @ tilted(float(cup.pose[3]))
        held = (np.hypot(local[:, 0], local[:, 1]) < cup.shape.inner) & (
            np.abs(local[:, 2]) < cup.shape.tall / 2
        )
        flat = np.hypot(self._x[:, 0] - cup.place[0], self._x[:, 1] - cup.place[1])
        caught = (flat < cup.container.inner) & (self._x[:, 2] < cup.container.tall + THICKNESS)
        caught &= ~held
        lost = ~held & ~caught & (self._x[:, 2] < 2 * SPACING)
        return np.array([held.mean(), caught.mean(), lost.mean()])

    def _step(self, poses: NDArray[np.float64], viscosity: float) -> None:
        self._hit[:] = 0
        water_step(
            self._x,
            self._last,
            self.velocities,
            self._mix,
            self.number,
            self.density,
            self._near,
            self._grid,
            self._start,
            self._rows,
            self._bins,
            self._order,
            self._path(poses),
            self._sizes,
            self._hit,
            FRAME,
            PER_SEARCH,
            RADIUS,
            REACH,
            ALONE,
            1 - np.exp(-viscosity * FRAME * PER_SEARCH / SUBSTEPS),
        )
        self.touches = tuple(bool(hit) for hit in self._hit)

    def _path(self, poses: NDArray[np.float64]) -> NDArray[np.float32]:
        """Floor centres and tilts of cup and container after each substep."""
        path = np.zeros((len(poses), 2, 5))
        c, s, half = np.cos(poses[:, 3]), np.sin(poses[:, 3]), self.cup.shape.tall / 2
        path[:, 0, :3] = poses[:, :3] - half * np.stack([s, np.zeros_like(s), c], 1)
        path[:, 0, 3], path[:, 0, 4] = c, s
        path[:, 1] = [*self.cup.place, THICKNESS, 1, 0]
        return path.astype(np.float32)


def _loose(cup: Cup, level: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Particles at rest spacing in the upright cup, layer by layer, in random order."""
    count = count_for(level, cup.shape.inner)
    points = _layers(count, cup.shape.inner, rng)
    points[:, 2] -= cup.shape.tall / 2
    return (points + cup.pose[:3]).astype(np.float32)[rng.permutation(count)]


def _layers(count: int, inner: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Particles at rest spacing on the floor of an upright vessel, layer by layer, [count, 3]."""
    inner, layers, placed, z = inner - RADIUS, [], 0, RADIUS
    steps = np.arange(-inner - SPACING, inner + SPACING, SPACING)
    while placed < count:
        flat = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + rng.uniform(0, SPACING, 2)
        flat = flat + rng.normal(0, 0.05 * SPACING, flat.shape)
        flat = flat[np.hypot(flat[:, 0], flat[:, 1]) < inner]
        layers.append(np.column_stack([flat, np.full(len(flat), z)]))
        placed, z = placed + len(flat), z + SPACING
    return np.concatenate(layers)[:count]
