"""reacher: a two-link arm in a plane, driven by joint torques, brings its tip to a marker."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import RecipeError
from acwm_kinematics.physics import MARKER_RADIUS
from acwm_kinematics.reacher_arm import Arm, Links, Vector, wrapped
from acwm_kinematics.reacher_drawing import (
    GOAL_ID,
    INNER,
    TIP_ID,
    ReacherDrawing,
)
from acwm_kinematics.reacher_policy import Reacher, Region
from acwm_kinematics.states import REACHER_CAMERA, REACHER_STATE
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

LIMITS = {"central": (-3.3, 3.5), "corner": (-3.7, 4.2)}
"""Least and largest torque of the behaviour policy in N·m, by the factor `goal`.

The paper gives these figures in "rad" although its action is a torque. The masses and lengths of
the links are chosen so that the figures, taken as N·m, move the arm by a few radians per second.
"""

_FACTORS = (
    Factor.discrete(
        "goal",
        "where goals lie: outside or inside the corner sectors, for which the policy uses "
        "torques in [-3.3, 3.5] and [-3.7, 4.2] N·m",
        train=("central",),
        ood=("corner",),
        nominal="central",
        active=True,
    ),
    Factor.continuous(
        "forearm_length",
        "length of the forearm",
        train=(0.38, 0.42),
        ood=((0.28, 0.33), (0.46, 0.50)),
        nominal=0.4,
        unit="m",
    ),
    Factor.continuous(
        "forearm_mass",
        "mass of the forearm",
        train=(1.3, 1.7),
        ood=((0.4, 0.8), (2.5, 3.5)),
        nominal=1.5,
        unit="kg",
    ),
    Factor.continuous(
        "damping",
        "viscous damping of both joints",
        train=(0.5, 0.7),
        ood=((0.0, 0.2), (1.2, 1.8)),
        nominal=0.6,
        unit="N·m·s/rad",
    ),
    appearance("colors", "colours of arm and marker", "blue", "violet", "pastel"),
    LIGHT,
    appearance("camera", "where the scene is seen from", "front", "top", "corner"),
)

_MIRROR = Symmetry((-1, -2), mirrored=True, states={"joint_velocity": (-1, -2)})


class ReacherArm(SceneEnvironment[Arm]):
    """A two-link arm in a horizontal plane, on a walled floor with a flat marker as goal.

    The action is a constant torque per joint; positive torques turn the joint counter-clockwise
    seen from above. Gravity has no effect and the arm cannot reach the walls, so this is a free
    two-link manipulator with viscous joints. The marker is not solid: a contact of fingertip and
    goal means that the tip is above the marker.
    """

    drawn_by = ReacherDrawing
    card = EnvironmentCard(
        name="reacher",
        summary="A two-link arm, driven by joint torques, brings its fingertip to a marker.",
        action=ActionSpec(
            names=("shoulder_torque", "elbow_torque"),
            units=("N·m", "N·m"),
            low=(LIMITS["corner"][0],) * 2,
            high=(LIMITS["corner"][1],) * 2,
            kind="torque",
        ),
        frame_size=(240, 240),
        fps=10,
        horizon=50,
        factors=_FACTORS,
        ood_shifts=("goal",),
        state=REACHER_STATE,
        instances=("floor", "wall", "base", "upper_arm", "forearm", "fingertip", "goal"),
        engine="MuJoCo",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        symmetries=(_MIRROR,),
        camera=REACHER_CAMERA,
    )

    def _begin(self, factors: Factors, rng: np.random.Generator) -> Arm:
        links = _links(factors)
        self._region = Region(corners=factors["goal"] == "corner")
        goal = self._region.sample(links.reach, rng)
        self._met = False
        while True:
            arm = Arm(links, rng.uniform(-np.pi, np.pi, 2), goal)
            if arm.distance >= 4 * MARKER_RADIUS:
                return arm

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Rotate both joints slightly."""
        arm = self.simulation
        angles = arm.angles + amount * rng.normal(0, 1e-3, 2)
        self.simulation = Arm(arm.links, angles, arm.goal)

    def _transform(self, symmetry: Symmetry) -> None:
        arm = self.simulation
        shoulder, elbow = arm.angles
        self.simulation = Arm(arm.links, np.array([np.pi - shoulder, -elbow]), arm.goal * [-1, 1])

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._met = False
        torque, looks = action.astype(np.float64), 5
        for _ in range(looks):
            self.simulation.advance(torque, 1 / self.card.fps / looks)
            self._met = self._met or self.simulation.distance < MARKER_RADIUS

    def _state(self) -> dict[str, NDArray[Any]]:
        arm = self.simulation
        elbow, tip = arm.points(arm.angles)
        state = {
            "joint_angle": wrapped(arm.angles),
            "joint_velocity": arm.velocities,
            "elbow_position": elbow,
            "fingertip_position": tip,
            "fingertip_velocity": arm.tip_velocity,
            "goal_position": arm.goal,
        }
        return {name: value.astype(np.float32) for name, value in state.items()}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return ((TIP_ID, GOAL_ID),) if self._met else ()

    def policy(self, rng: np.random.Generator) -> Policy:
        """Reach for the goal and other places, hold, try torques and coast."""
        return self._reacher(rng).next_torque

    def reaching(self, rng: np.random.Generator) -> Policy:
        """Only reach for the goal."""
        reacher = self._reacher(rng)
        reacher.insist()
        return reacher.next_torque

    def put(self, angles: Vector) -> None:
        """Set the joint angles [2], at rest."""
        self.simulation, self._met = Arm(self.simulation.links, angles, self.simulation.goal), False

    def _reacher(self, rng: np.random.Generator) -> Reacher:
        limits = LIMITS[str(self._factors["goal"])]
        return Reacher(self.simulation, self.simulation.goal, self._region, limits, rng)


def _links(factors: Factors) -> Links:
    """The arm of an episode; raises RecipeError if it is impossible or would hit the walls."""
    length, mass, damping = (
        float(factors[name]) for name in ("forearm_length", "forearm_mass", "damping")
    )
    upper, most = Links().lengths[0], INNER - Links().lengths[0] - 0.05
    if not 0.1 <= length <= most:
        raise RecipeError(f"factors.forearm_length={length:g}: give 0.1 to {most:.2f} m")
    if not mass > 0:
        raise RecipeError(f"factors.forearm_mass={mass:g}: a mass must be positive")
    if not damping >= 0:
        raise RecipeError(f"factors.damping={damping:g}: damping cannot be negative")
    return Links((upper, length), (Links().masses[0], mass), damping)
