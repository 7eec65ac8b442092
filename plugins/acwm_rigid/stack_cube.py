"""stack_cube: a Franka Panda puts a red cube onto a green one."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import (
    ActionSpec,
    Environment,
    EnvironmentCard,
    Policy,
    StateField,
    check_limits,
)
from acwm_core.episode import Factor, FactorValue
from acwm_rigid.stack_look import Look
from acwm_rigid.stack_policy import Stacker
from acwm_rigid.stack_world import GREEN, RED, StackWorld, Start

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
"""Degrees from +x, which points away from the robot and is north; +y, its left, is west."""

SPREAD = 15.0
"""Degrees to either side by which a direction varies, so that no two of them meet."""

DISTANCE = (0.12, 0.20)
"""Range of metres between the cubes."""

_MIDDLE = np.array([[0.43, -0.10], [0.54, 0.10]])  # metres; where the point between the cubes lies
_HAND = np.array([[0.38, -0.12, 0.22], [0.52, 0.12, 0.32]])  # where the hand starts

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
    Factor.discrete(
        "colors",
        "colours of the cubes",
        train=("bright",),
        ood=("dark", "pastel"),
        nominal="bright",
    ),
    Factor.discrete(
        "light", "sun and sky", train=("noon",), ood=("evening", "overcast"), nominal="noon"
    ),
    Factor.discrete(
        "camera", "where it looks from", train=("front",), ood=("side", "high"), nominal="front"
    ),
)

_LIMITS = {"friction": (0.0, 5.0), "mass": (0.005, 2.0), "cube_size": (0.02, 0.075)}
"""What the simulation can take."""

_ACTION = ActionSpec(
    names=("delta_x", "delta_y", "delta_z", "delta_rx", "delta_ry", "delta_rz", "gripper"),
    units=("m", "m", "m", "rad", "rad", "rad", ""),
    low=(-0.05, -0.05, -0.05, -0.25, -0.25, -0.25, -1.0),
    high=(0.05, 0.05, 0.05, 0.25, 0.25, 0.25, 1.0),
    kind="delta",
)

_STATE = (
    StateField("joint_position", (7,), "rad", "angles of the arm's joints"),
    StateField("joint_velocity", (7,), "rad/s", "of the arm's joints"),
    StateField("hand_position", (3,), "m", "grasping point; the robot's base is the origin, z up"),
    StateField("hand_quaternion", (4,), "", "orientation of the hand (w, x, y, z)"),
    StateField("gripper_opening", (1,), "m", "distance between the fingertips"),
    StateField("cube_position", (2, 3), "m", "centres of the red and the green cube"),
    StateField("cube_quaternion", (2, 4), "", "orientations (w, x, y, z)"),
    StateField("cube_velocity", (2, 3), "m/s", "velocities of the centres"),
    StateField("cube_angular_velocity", (2, 3), "rad/s", "in the world's frame"),
    StateField("stacked", (1,), "", "1 when the red cube rests on the green one, released"),
)


class StackCube(Environment):
    """A Franka Panda, a red cube and a green cube on a floor.

    The action moves the target of the hand: by metres along the world's axes (+x away from the
    robot, +y to its left, +z up), by a rotation vector in the world's frame (rad), and the gripper,
    which −1 closes and +1 opens by half its way; so zero holds everything as it is. The target
    stays in the workspace and near the hand, which follows it with the arm's own motors; a turn to
    where the arm cannot hold its hand is not done.
    """

    card = EnvironmentCard(
        name="stack_cube",
        summary="A Franka Panda grasps a red cube and puts it onto a green one.",
        action=_ACTION,
        frame_size=(240, 240),
        fps=10,
        horizon=57,
        factors=_FACTORS,
        ood_shifts=("direction",),
        state=_STATE,
        instances=("floor", "arm", "gripper", "red_cube", "green_cube"),
        engine="PyBullet",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
    )

    def __init__(
        self,
        *,
        size: int | tuple[int, int] | None = None,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        super().__init__(size=size, render_mode=render_mode)
        self._look = Look(self.frame_size)
        self._world: StackWorld | None = None

    def close(self) -> None:
        """Free the physics world."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        check_limits(factors, _LIMITS)
        edge = float(factors["cube_size"])
        cubes = _place(DIRECTIONS[str(factors["direction"])], rng)
        hand = rng.uniform(*_HAND)
        mass, friction = float(factors["mass"]), float(factors["friction"])
        self._begin(Start(cubes, hand, edge, mass, friction))
        self._look.dress(str(factors["colors"]), str(factors["light"]), str(factors["camera"]))

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move the cubes and the hand, turn the cubes."""
        start, moved = self.world.start, amount * rng.normal(0, 1e-3, 9)
        cubes, hand = start.cubes + moved[:6].reshape(2, 3), start.hand + moved[6:]
        self._begin(replace(start, cubes=cubes, hand=hand))

    def _begin(self, start: Start) -> None:
        self.close()
        self._world = StackWorld(start)
        self._touched = self._world.touching()

    @property
    def world(self) -> StackWorld:
        """The running episode's physics."""
        assert self._world is not None, "reset() comes first"
        return self._world

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._touched = self.world.advance(action.astype(np.float64), 1 / self.card.fps)

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        return self._look.draw(self.world.poses, self.world.edge)

    def _state(self) -> dict[str, NDArray[Any]]:
        world = self.world
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
        """Put the red cube onto the green one, each time in another manner."""
        stacker, action = Stacker(self.world, rng), self.card.action

        def act() -> NDArray[np.float64]:
            return np.clip(stacker.next_action(), action.low, action.high)

        return act


def _place(degrees: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Rows (x, y, yaw) of the red and the green cube, which lies in that direction of it."""
    angle = np.radians(degrees + rng.uniform(-SPREAD, SPREAD))
    way = rng.uniform(*DISTANCE) * np.array([np.cos(angle), np.sin(angle)])
    middle = rng.uniform(*_MIDDLE)
    cubes = np.zeros((2, 3))
    cubes[RED, :2], cubes[GREEN, :2] = middle - way / 2, middle + way / 2
    cubes[:, 2] = rng.uniform(-np.pi / 4, np.pi / 4, 2)
    return cubes
