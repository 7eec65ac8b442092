"""The physics of the reacher: two links that turn in a horizontal plane, driven by torques."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_sim.mujoco import mujoco

TIMESTEP = 1 / 200
"""Seconds per fourth-order Runge-Kutta step; energy is then conserved to 1e-6 over an episode."""

LINK_RADIUS = 0.06
"""Half width of a link, metres; both links are treated as solid cylinders of this radius."""

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Links:
    """The links of the arm. The upper arm turns about the shoulder, the forearm about its end.

    Attributes:
        lengths: lengths of upper arm and forearm in metres, from joint to joint or tip.
        masses: their masses in kg, spread evenly along each link.
        damping: viscous damping of each joint, N·m·s/rad.
        rotor: inertia of each motor's rotor as seen by the joint through its gears, kg·m².
    """

    lengths: tuple[float, float] = (0.5, 0.4)
    masses: tuple[float, float] = (2.0, 1.5)
    damping: float = 0.6
    rotor: float = 0.12

    @property
    def reach(self) -> float:
        """Largest distance of the fingertip from the shoulder, metres."""
        return sum(self.lengths)


class Arm:
    """The arm of one episode. It is newly built, so nothing is left of other episodes.

    Both joints turn without limits, as the forearm passes above the upper arm, and nothing is
    within reach of the fingertip. So the two equations of motion describe everything.

    Args:
        links: sizes and masses.
        angles: [2] initial angles in radians: of the upper arm from +x, of the forearm from the
            upper arm, counter-clockwise seen from above.
        goal: [2] centre of the marker that the fingertip should reach, metres.
    """

    def __init__(self, links: Links, angles: Vector, goal: Vector | None = None) -> None:
        self.links = links
        self.goal = np.zeros(2) if goal is None else goal
        self.model = mujoco.MjModel.from_xml_string(_xml(links))
        self.data = mujoco.MjData(self.model)
        self._scratch = mujoco.MjData(self.model)
        self.data.qpos[:] = angles

    def advance(self, torque: Vector, seconds: float) -> None:
        """Apply constant torques ([2], N·m) for some seconds."""
        self.data.ctrl[:] = torque
        mujoco.mj_step(self.model, self.data, nstep=round(seconds / TIMESTEP))

    def snapshot(self) -> Callable[[], None]:
        """A function that returns to this moment."""
        data = copy.copy(self.data)
        return lambda: mujoco.mj_copyData(self.data, self.model, data)

    @property
    def angles(self) -> Vector:
        """Joint angles [2], radians, unwrapped."""
        return self.data.qpos.copy()

    @property
    def velocities(self) -> Vector:
        """Joint velocities [2], rad/s."""
        return self.data.qvel.copy()

    def torque_for(self, angles: Vector, velocities: Vector, accelerations: Vector) -> Vector:
        """The torques [2] in N·m that cause these accelerations (rad/s²) in this state."""
        data = self._scratch
        data.qpos[:], data.qvel[:], data.qacc[:] = angles, velocities, accelerations
        mujoco.mj_inverse(self.model, data)
        return data.qfrc_inverse.copy()

    def points(self, angles: Vector) -> Vector:
        """Elbow and fingertip at these angles [..., 2]: [..., 2, 2], metres from the shoulder."""
        heading = np.cumsum(angles, axis=-1)
        steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return np.cumsum(steps * np.array(self.links.lengths)[:, None], axis=-2)

    @property
    def tip(self) -> Vector:
        """Position of the fingertip [2], metres from the shoulder."""
        return self.points(self.angles)[1]

    @property
    def distance(self) -> float:
        """Distance of the fingertip from the goal, metres."""
        return float(np.linalg.norm(self.tip - self.goal))

    @property
    def tip_velocity(self) -> Vector:
        """Velocity of the fingertip [2], m/s."""
        elbow, tip = self.points(self.angles)
        shoulder_rate, elbow_rate = self.data.qvel
        return shoulder_rate * _turned(tip) + elbow_rate * _turned(tip - elbow)

    def angles_for(self, tip: Vector, bend: int) -> Vector:
        """Angles [2], in [-π, π], that bring the fingertip to `tip`, or as close as possible.

        Args:
            tip: [2] metres.
            bend: 1 for an elbow that turns counter-clockwise, -1 for the mirror image.
        """
        upper, fore = self.links.lengths
        cosine = (tip @ tip - upper**2 - fore**2) / (2 * upper * fore)
        elbow = bend * np.arccos(np.clip(cosine, -1.0, 1.0))
        inner = np.arctan2(fore * np.sin(elbow), upper + fore * np.cos(elbow))
        shoulder = np.arctan2(tip[1], tip[0]) - inner
        return np.array([wrapped(shoulder), elbow])

    def postures_for(self, tip: Vector) -> list[Vector]:
        """Both sets of angles [2] that bring the fingertip to `tip`, the nearer one first."""
        here = self.angles
        both = [here + wrapped(self.angles_for(tip, bend) - here) for bend in (-1, 1)]
        return sorted(both, key=lambda end: float(np.abs(end - here).max()))


def wrapped(angle: Vector) -> Vector:
    """Wrap angles to [-π, π]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _turned(vector: Vector) -> Vector:
    """A vector [2] rotated left by 90°."""
    return np.array([-vector[1], vector[0]])


def _xml(links: Links) -> str:
    """The MuJoCo model as XML. It has no shapes, as nothing collides; inertias are explicit."""
    motors = "".join(f'<motor joint="{name}"/>' for name in ("shoulder", "elbow"))
    forearm = _link_xml("elbow", links.lengths[0], links.lengths[1], links.masses[1], links, "")
    arm = _link_xml("shoulder", 0.0, links.lengths[0], links.masses[0], links, forearm)
    return (
        f'<mujoco><option timestep="{TIMESTEP}" integrator="RK4"/><worldbody>{arm}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def _link_xml(
    joint: str, start: float, length: float, mass: float, links: Links, inner: str
) -> str:
    """A solid cylinder along x that turns about z at its start, with the XML of its child body."""
    along = mass * LINK_RADIUS**2 / 2
    across = mass * (length**2 / 12 + LINK_RADIUS**2 / 4)
    return (
        f'<body pos="{start} 0 0"><joint name="{joint}" axis="0 0 1" damping="{links.damping}"'
        f' armature="{links.rotor}"/><inertial pos="{length / 2} 0 0" mass="{mass}"'
        f' diaginertia="{along} {across} {across}"/>{inner}</body>'
    )
