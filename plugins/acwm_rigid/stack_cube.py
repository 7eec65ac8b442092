"""stack_cube: a Franka Panda puts a red cube onto a green one."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_rigid.stack_drawing import StackDrawing
from acwm_rigid.stack_policy import Stacker
from acwm_rigid.stack_simulation import GREEN, RED, StackSimulation, Start
from acwm_rigid.states import PAIR, STACK_CAMERA, STACK_CUBE_STATE, STACK_LIGHT
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

DIRECTIONS = {
    "north": 0.0,
    "northwest": 45.0,
    "west": 90.0,
    "southwest": 135.0,
    "south": 180.0,
    "southeast": 225.0,
    "east": 270.0,
    "northeast": 315.0,
}
"""Degrees from +x. North is +x, away from the robot; west is +y, to the robot's left."""

SPREAD = 15.0
"""Degrees by which a direction varies to either side; directions do not overlap."""

DISTANCE = (0.12, 0.20)
"""Range of distances between the cubes in metres."""

_MIDDLE = np.array([[0.43, -0.10], [0.54, 0.10]])  # range of the point between the cubes, metres
_ABOVE = 0.15  # metres added to the edge of a cube for the height of the hand above a stack
_HAND = np.array([[0.38, -0.12, 0.22], [0.52, 0.12, 0.32]])  # range where the hand starts, metres

_FACTORS = (
    Factor.discrete(
        "direction",
        "where the green cube lies, seen from the red one",
        train=("northwest", "southwest", "southeast", "northeast"),
        ood=("north", "west", "south", "east"),
        nominal="northwest",
        active=True,
    ),
    Factor.continuous(
        "friction",
        "Coulomb friction of a cube on the floor",
        train=(0.8, 1.0),
        ood=((0.35, 0.5), (1.3, 1.6)),
        nominal=0.9,
    ),
    Factor.continuous(
        "mass",
        "mass of a cube",
        train=(0.07, 0.09),
        ood=((0.02, 0.035), (0.25, 0.4)),
        nominal=0.08,
        unit="kg",
    ),
    Factor.continuous(
        "cube_size",
        "length of a cube's edge",
        train=(0.048, 0.052),
        ood=((0.036, 0.042), (0.058, 0.064)),
        nominal=0.05,
        unit="m",
    ),
    appearance("colors", "colours of the cubes", "bright", "dark", "pastel"),
    LIGHT,
    appearance("camera", "where it looks from", "front", "side", "high"),
)

_LIMITS = {"friction": (0.0, 5.0), "mass": (0.005, 2.0), "cube_size": (0.02, 0.075)}
"""The factor values that the simulation accepts."""

_ACTION = ActionSpec(
    names=("delta_x", "delta_y", "delta_z", "delta_rx", "delta_ry", "delta_rz", "gripper"),
    units=("m", "m", "m", "rad", "rad", "rad", ""),
    low=(-0.05, -0.05, -0.05, -0.25, -0.25, -0.25, -1.0),
    high=(0.05, 0.05, 0.05, 0.25, 0.25, 0.25, 1.0),
    kind="delta",
)


class StackCube(SceneEnvironment[StackSimulation]):
    """A Franka Panda, a red cube and a green cube on a floor.

    The action moves the target of the hand: a translation along the world axes in metres (+x away
    from the robot, +y to its left, +z up), a rotation vector in the world frame (rad), and the
    gripper (−1 closes and +1 opens it by half of its range). A zero action holds everything. The
    target stays in the workspace and near the hand, which the arm's motors move. Rotations that the
    arm cannot hold are ignored.
    """

    drawn_by = StackDrawing
    limits = _LIMITS
    card = EnvironmentCard(
        name="stack_cube",
        summary="A Franka Panda grasps a red cube and puts it onto a green one.",
        action=_ACTION,
        frame_size=(240, 240),
        fps=10,
        horizon=57,
        factors=_FACTORS,
        ood_shifts=("direction",),
        state=STACK_CUBE_STATE,
        instances=("floor", "arm", "gripper", *PAIR),
        engine="PyBullet",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        camera=STACK_CAMERA,
        light=STACK_LIGHT,
    )

    def _begin(self, factors: Factors, rng: np.random.Generator) -> StackSimulation:
        edge = float(factors["cube_size"])
        cubes = _place(DIRECTIONS[str(factors["direction"])], rng)
        hand = rng.uniform(*_HAND)
        mass, friction = float(factors["mass"]), float(factors["friction"])
        return self._simulate(Start(cubes, hand, edge, mass, friction))

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move the cubes and the hand, and rotate the cubes."""
        start, moved = self.simulation.start, amount * rng.normal(0, 1e-3, 9)
        cubes, hand = start.cubes + moved[:6].reshape(2, 3), start.hand + moved[6:]
        self.simulation = self._simulate(replace(start, cubes=cubes, hand=hand))

    def _simulate(self, start: Start) -> StackSimulation:
        simulation = StackSimulation(start)
        self._touched = simulation.touching()
        return simulation

    def put_stacked(self) -> None:
        """Place the red cube square on the green one, at rest, with the hand above them."""
        start = self.simulation.start
        green = start.cubes[GREEN]
        hand = np.array([*green[:2], start.edge + _ABOVE])
        self.simulation = self._simulate(replace(start, hand=hand))
        self.simulation.put(RED, np.array([*green[:2], 1.5 * start.edge]), float(green[2]))

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._touched = self.simulation.advance(action.astype(np.float64), 1 / self.card.fps)

    def _state(self) -> dict[str, NDArray[Any]]:
        world = self.simulation
        hand, hand_turn = world.panda.hand_pose
        cubes, turns = world.cube_pose
        velocity, spin = world.cube_velocity
        values = {
            "joint_position": world.panda.joints,
            "joint_velocity": world.panda.joint_velocities,
            "hand_position": hand,
            "hand_quaternion": np.roll(hand_turn, 1),
            "gripper_opening": [world.panda.opening],
            "cube_position": cubes,
            "cube_quaternion": np.roll(turns, 1, axis=1),
            "cube_velocity": velocity,
            "cube_angular_velocity": spin,
            "stacked": [world.stacked],
        }
        return {name: np.array(value, np.float32) for name, value in values.items()}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return self._touched

    def policy(self, rng: np.random.Generator) -> Policy:
        """Put the red cube onto the green one, in a different manner each time."""
        return self.clipped(Stacker(self.simulation, rng).next_action)


def _place(degrees: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Rows (x, y, yaw) of the red cube, and of the green cube in that direction from it."""
    angle = np.radians(degrees + rng.uniform(-SPREAD, SPREAD))
    way = rng.uniform(*DISTANCE) * np.array([np.cos(angle), np.sin(angle)])
    middle = rng.uniform(*_MIDDLE)
    cubes = np.zeros((2, 3))
    cubes[RED, :2], cubes[GREEN, :2] = middle - way / 2, middle + way / 2
    cubes[:, 2] = rng.uniform(-np.pi / 4, np.pi / 4, 2)
    return cubes
