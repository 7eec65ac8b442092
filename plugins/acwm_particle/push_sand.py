"""push_sand: a board pushes thousands of grains of sand on a table."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry
from acwm_particle.physics import BOARD, HEIGHT_EXTENT
from acwm_particle.sand import CLEARANCE, FRAME, Pose, Sand
from acwm_particle.sand_drawing import BOARD_ID, SAND_ID, SandDrawing
from acwm_particle.sand_layout import DOUBLED, GRAINS, pour
from acwm_particle.sand_policy import Raker, heading
from acwm_particle.states import GRAINS_RECORDED, HEIGHT_CELLS, PUSH_SAND_STATE, SAND_CAMERA, SUN
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

RADIUS = 0.0105
"""Radius of a grain in metres."""

_SETTLING = 20  # frames before frame 0 in which the poured sand comes to rest

_FACTORS = (
    Factor.discrete(
        "grain_count",
        "how many grains",
        train=(GRAINS,),
        ood=(DOUBLED,),
        nominal=GRAINS,
        active=True,
    ),
    Factor.discrete(
        "layout",
        "how the sand lies at first",
        train=("slab", "heap"),
        ood=("twins", "ridge"),
        nominal="slab",
        active=True,
    ),
    Factor.continuous(
        "friction",
        "Coulomb friction between grains",
        train=(0.45, 0.65),
        ood=((0.04, 0.2),),  # more friction than in training hardly steepens heaps
        nominal=0.55,
    ),
    Factor.continuous(
        "board_width",
        "width of the board",
        train=(0.28, 0.32),
        ood=((0.14, 0.2), (0.42, 0.5)),
        nominal=0.30,
        unit="m",
    ),
    appearance("colors", "colour of the sand", "dune", "slate", "terracotta"),
    LIGHT,
    appearance("camera", "where it looks from", "front", "left", "top"),
)

_LIMITS = {"friction": (0.0, 2.0), "board_width": (0.05, 0.7)}
"""The factor values that the simulation accepts."""

_ACTION = ActionSpec(
    names=("delta_x", "delta_y", "delta_z", "delta_qw", "delta_qx", "delta_qy", "delta_qz"),
    units=("m", "m", "m", "", "", "", ""),
    low=(-0.04, -0.04, -0.04, -0.15, -0.15, -0.15, -0.15),
    high=(0.04, 0.04, 0.04, 0.15, 0.15, 0.15, 0.15),
    kind="delta",
)

# The sand's own state is not exactly mirrored: the order in which grains are treated is not, so
# that a mirrored heap shifts by a millimetre, and then grains part as after any other start.
_MIRROR = Symmetry((-1, 2, 3, 4, 5, -6, -7), mirrored=True)


class PushSand(SceneEnvironment[Sand]):
    """Sand on a table and a board that moves through it.

    The action moves the board along the world axes in metres (+x right, +y away from the camera,
    +z up) and is added to its quaternion, which is then normalised. A zero action holds it still.
    The board moves at constant speed during the frame, stays over the table and above its surface,
    and is not slowed by the sand.

    Grains do not rotate and move at 0.84 m/s at most. Where the board squeezes them, some pairs
    overlap. Out of distribution there are twice as many grains, as in the paper's table; the
    layouts of its appendix are the factor `layout`.
    """

    drawn_by = SandDrawing
    limits = _LIMITS
    card = EnvironmentCard(
        name="push_sand",
        summary="A board pushes thousands of grains of sand about a table.",
        action=_ACTION,
        frame_size=(240, 400),
        fps=round(1 / FRAME),
        horizon=64,
        factors=_FACTORS,
        ood_shifts=("grain_count",),
        state=PUSH_SAND_STATE,
        instances=("ground", "sand", "board"),
        engine="Taichi (PBD)",
        episodes={"train": 1784, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        symmetries=(_MIRROR,),
        camera=SAND_CAMERA,
        light=SUN,
    )

    def _begin(self, factors: Factors, rng: np.random.Generator) -> Sand:
        grains = pour(int(factors["grain_count"]), RADIUS, str(factors["layout"]), rng)
        half = np.array([BOARD[0], float(factors["board_width"]) / 2, BOARD[2]])
        sand = Sand(grains, RADIUS, float(factors["friction"]), half)
        sand.settle(_SETTLING)
        sand.put_board(_beside(sand, rng))
        self._before = sand.board.position
        return sand

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move the sand as a whole, and move the board and rotate it about the vertical."""
        shift, turn = amount * rng.normal(0, 1e-3, 5), amount * rng.normal(0, 1e-3)
        board = self.simulation.board
        self.simulation.grains[:, :2] += shift[:2].astype(np.float32)
        (w, x, y, z), c, s = board.quaternion, np.cos(turn / 2), np.sin(turn / 2)
        turned = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
        self.simulation.put_board(Pose(board.position + shift[2:], turned))
        self._before = self.simulation.board.position

    def _transform(self, symmetry: Symmetry) -> None:
        board = self.simulation.board
        self.simulation.grains[:, 0] *= -1
        turn = board.quaternion * [1, 1, -1, -1]
        self.simulation.put_board(Pose(board.position * [-1, 1, 1], turn))
        self._before = self.simulation.board.position

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._before = self.simulation.board.position
        self.simulation.advance(action.astype(np.float64))

    def _state(self) -> dict[str, NDArray[Any]]:
        sand, board = self.simulation, self.simulation.board
        return {
            "grain_position": sand.grains[:GRAINS_RECORDED].astype(np.float16),
            "grain_count": np.array([len(sand.grains)], np.int32),
            "sand_center": sand.grains.mean(0, dtype=np.float64).astype(np.float32),
            "sand_height": height_map(sand.grains, sand.radius),
            "board_position": board.position.astype(np.float32),
            "board_quaternion": board.quaternion.astype(np.float32),
            "board_velocity": ((board.position - self._before) / FRAME).astype(np.float32),
        }

    def _contacts(self) -> Iterable[tuple[int, int]]:
        if self.simulation.touches_ground:
            yield 0, SAND_ID
        if self.simulation.touches_board:
            yield SAND_ID, BOARD_ID

    def policy(self, rng: np.random.Generator) -> Policy:
        """Mostly push, cut and sweep through the sand, otherwise wander or pause."""
        return self.clipped(Raker(self.simulation, rng).next_action)


def height_map(grains: NDArray[np.float32], radius: float) -> NDArray[np.float16]:
    """Height of the sand in each cell of the grid in metres, zero without sand."""
    (rows, columns), (deep, wide) = HEIGHT_CELLS, HEIGHT_EXTENT
    row = np.floor((grains[:, 1] + deep) / (2 * deep) * rows).astype(int)
    column = np.floor((grains[:, 0] + wide) / (2 * wide) * columns).astype(int)
    there = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    heights = np.zeros((rows, columns), np.float32)
    np.maximum.at(heights, (row[there], column[there]), grains[there, 2] + radius)
    return heights.astype(np.float16)


def _beside(sand: Sand, rng: np.random.Generator) -> Pose:
    """Draw a pose for the board next to the sand, facing it."""
    middle, angle = sand.grains[:, :2].mean(0), rng.uniform(-np.pi, np.pi)
    away = np.array([np.cos(angle), np.sin(angle)])
    edge = float((np.asarray((sand.grains[:, :2] - middle)) @ away).max())
    place = middle + away * (edge + 0.05)
    height = float(sand.half[2]) + CLEARANCE + (rng.random() < 0.3) * rng.uniform(0, 0.12)
    return Pose(np.array([*place, height]), heading(angle + np.pi + rng.normal(0, 0.3)))
