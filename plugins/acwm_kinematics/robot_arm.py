"""robot_arm: a Franka Panda moves from goal to goal around the posts on its table."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.errors import RecipeError
from acwm_kinematics.arm_drawing import (
    ARM_ID,
    FIRST_POST_ID,
    GRIPPER_ID,
    TABLE_ID,
    ArmDrawing,
)
from acwm_kinematics.arm_layout import ArmLayout, Workspace, draw_layout
from acwm_kinematics.arm_planner import Joints
from acwm_kinematics.arm_policy import Reacher
from acwm_kinematics.arm_simulation import MAX_STEP, ArmSimulation, Servos
from acwm_kinematics.states import (
    ARM_CAMERA,
    ARM_LIGHT,
    GOAL_NAMES,
    GOALS,
    MAX_POSTS,
    POST_NAMES,
    ROBOT_ARM_STATE,
)
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

_MAX_HEIGHT = 0.6
"""Metres; taller posts leave no room for goals."""

_FACTORS = (
    Factor.discrete(
        "workspace",
        "where goals lie: a central box, for which joints turn by [-0.95, 0.58] rad from home, or "
        "around it, for which they turn by [-1.15, 0.88] rad",
        train=("central",),
        ood=("expanded",),
        nominal="central",
        active=True,
    ),
    Factor.discrete(
        "obstacle_count",
        "how many posts stand on the table",
        train=(1, 2, 3),
        ood=(0, 4),
        nominal=2,
        active=True,
    ),
    Factor.continuous(
        "obstacle_height",
        "most that a post's height can be; each has 60 to 100 % of it",
        train=(0.22, 0.30),
        ood=((0.05, 0.10), (0.38, 0.48)),
        nominal=0.26,
        unit="m",
    ),
    Factor.continuous(
        "servo_lag",
        "time constant with which joints follow their targets",
        train=(0.0, 0.02),
        ood=((0.08, 0.20),),
        nominal=0.0,
        unit="s",
    ),
    Factor.continuous(
        "motor_strength",
        "torque limits of the motors, relative to the data sheet's",
        train=(0.9, 1.1),
        ood=((0.28, 0.38),),
        nominal=1.0,
    ),
    appearance("colors", "colours of the posts", "bright", "pastel"),
    LIGHT,
    appearance("camera", "where it looks from", "front", "side", "high"),
)

_JOINTS = tuple(f"delta_joint_{k}" for k in range(1, 8))


class RobotArm(SceneEnvironment[ArmSimulation]):
    """A Franka Panda at a table with posts, and goals in the air for its hand to visit.

    The action is added to the targets of the seven joints: +0.05 turns a joint by 0.05 rad within
    the frame. Servos with Franka's torque limits follow. The arm stays within its joint limits and
    stops at the table, posts and itself; targets wait for blocked joints. Goals are not solid: a
    goal turns green for good when the point between the fingertips comes within 2 cm of it.
    """

    drawn_by = ArmDrawing
    card = EnvironmentCard(
        name="robot_arm",
        summary="A Franka Panda moves from goal to goal around the posts on its table.",
        action=ActionSpec(
            names=_JOINTS,
            units=("rad",) * 7,
            low=(-MAX_STEP,) * 7,
            high=(MAX_STEP,) * 7,
            kind="delta",
        ),
        frame_size=(240, 240),
        fps=10,
        horizon=64,
        factors=_FACTORS,
        ood_shifts=("workspace",),
        state=ROBOT_ARM_STATE,
        instances=(
            "floor",
            "table",
            "arm",
            "gripper",
            *POST_NAMES,
            *GOAL_NAMES,
        ),
        engine="PyBullet",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        camera=ARM_CAMERA,
        light=ARM_LIGHT,
    )

    _layout: ArmLayout | None = None

    def close(self) -> None:
        super().close()
        if self._layout is not None:
            self._layout.clearance.close()
            self._layout = None

    def _begin(self, factors: Factors, rng: np.random.Generator) -> ArmSimulation:
        height, servos = _checked(factors)
        self.close()
        self._workspace = Workspace(str(factors["workspace"]))
        posts = int(factors["obstacle_count"])
        self._layout = draw_layout(self._workspace, posts, height, rng)
        return self._simulate(self._layout, servos)

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Rotate the arm's joints slightly; by less if it would hit something."""
        layout, servos, turn = self.layout, self.simulation.servos, rng.normal(0, 1e-3, 7)
        while not layout.clearance.is_free(layout.start + amount * turn):
            amount /= 2
        self._layout = replace(layout, start=layout.start + amount * turn)
        self.simulation = self._simulate(self._layout, servos)

    def _simulate(self, layout: ArmLayout, servos: Servos) -> ArmSimulation:
        self._touched = set[tuple[int, int]]()
        posts = len(layout.posts)
        goal_ids = range(FIRST_POST_ID + MAX_POSTS, FIRST_POST_ID + MAX_POSTS + GOALS)
        ids = (TABLE_ID, ARM_ID, GRIPPER_ID, *range(FIRST_POST_ID, FIRST_POST_ID + posts))
        return ArmSimulation(layout.start, layout.posts, layout.goals, servos, (*ids, *goal_ids))

    @property
    def layout(self) -> ArmLayout:
        """The initial layout of the current episode."""
        assert self._layout is not None, "reset() comes first"
        return self._layout

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._touched = self.simulation.advance(action.astype(np.float64), 1 / self.card.fps)

    def _state(self) -> dict[str, NDArray[Any]]:
        world = self.simulation
        state = {f.name: np.zeros(f.shape, np.float32) for f in self.card.state}
        position, quaternion = world.panda.hand_pose
        state["joint_position"][:] = world.panda.joints
        state["joint_velocity"][:] = world.panda.joint_velocities
        state["joint_target"][:] = world.target
        state["link_position"][:] = world.link_positions
        state["hand_position"][:] = position
        state["hand_quaternion"][:] = np.roll(quaternion, 1)
        state["hand_velocity"][:] = world.grasp_velocity
        state["goal_position"][:] = world.goals
        state["goal_reached"][:] = world.reached
        for k, post in enumerate(world.posts):
            state["obstacle_present"][k] = 1
            state["obstacle_position"][k] = (*post.place, post.height / 2)
            state["obstacle_size"][k] = (post.radius, post.height)
        return dict(state)

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return self._touched

    def policy(self, rng: np.random.Generator) -> Policy:
        """Visit goals and other places along collision-free motions, rest and try small motions."""
        return self.clipped(self._reacher(rng).next_turn)

    def reaching(self, hand: NDArray[np.float64], rng: np.random.Generator) -> Policy:
        """Go to the goal nearest to `hand` ([3], metres) and stay there."""
        goal = int(np.linalg.norm(self.layout.goals - hand, axis=1).argmin())
        reacher = self._reacher(rng)
        reacher.insist(self.layout.poses[goal])
        return self.clipped(reacher.next_turn)

    def put(self, joints: Joints) -> None:
        """Set the joint angles [7], at rest."""
        self.simulation = self._simulate(replace(self.layout, start=joints), self.simulation.servos)

    def _reacher(self, rng: np.random.Generator) -> Reacher:
        seconds = 1 / self.card.fps
        return Reacher(self.simulation, self.layout, self._workspace, seconds, rng)


def _checked(factors: Factors) -> tuple[float, Servos]:
    """Largest post height and the servos of an episode; raises RecipeError if impossible."""
    names = ("obstacle_height", "servo_lag", "motor_strength")
    height, lag, strength = (float(factors[name]) for name in names)
    if not 0.02 <= height <= _MAX_HEIGHT:
        raise RecipeError(f"factors.obstacle_height={height:g}: give 0.02 to {_MAX_HEIGHT:g} m")
    if not 0 <= lag <= 1:
        raise RecipeError(f"factors.servo_lag={lag:g}: give 0 to 1 s")
    if not strength > 0:
        raise RecipeError(f"factors.motor_strength={strength:g}: motors need some torque")
    return height, Servos(lag, strength)
