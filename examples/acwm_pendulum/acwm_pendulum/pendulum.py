"""The environment: a card and the six methods that every environment implements."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, Policy, StateField
from acwm_core.env.episode import Factor, FactorValue
from acwm_pendulum.drawing import VIEW, draw

GRAVITY = 9.81  # m/s²
MASS = 1.0  # kg
MAX_TORQUE = 4.0  # N·m
SUBSTEPS = 10  # integration steps per frame

CARD = EnvironmentCard(
    name="pendulum",
    summary="A damped pendulum driven by a torque at its pivot.",
    action=ActionSpec(("torque",), ("N·m",), (-MAX_TORQUE,), (MAX_TORQUE,), "torque"),
    frame_size=(128, 128),
    fps=20,
    horizon=64,
    factors=(
        Factor.continuous(
            "length",
            "pivot to bob",
            train=(0.7, 1.0),
            ood=((0.45, 0.55),),
            nominal=0.85,
            unit="m",
            active=True,
        ),
        Factor.continuous(
            "damping",
            "torque per angular velocity",
            train=(0.05, 0.15),
            ood=((0.4, 0.6),),
            nominal=0.1,
            unit="N·m·s",
        ),
    ),
    ood_shifts=("length", "damping"),
    state=(
        StateField(
            "angle",
            (),
            "rad",
            "from hanging down, anticlockwise",
            kind="angle",
            instances=("rod",),
            axis=(0, 0, 1),  # towards the viewer
        ),
        StateField("velocity", (), "rad/s", "rate of change of the angle"),
    ),
    instances=("background", "rod", "bob"),
    engine="numpy",
    camera=Camera.flat(VIEW / 2),
)


class Pendulum(Environment):
    """Starts at rest at a random angle; a positive torque drives it anticlockwise."""

    card = CARD

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self.length, self.damping = float(factors["length"]), float(factors["damping"])
        self.motion = np.array([rng.uniform(-1.0, 1.0), 0.0])  # angle, velocity

    def _advance(self, action: NDArray[np.float32]) -> None:
        dt, torque = 1 / self.card.fps / SUBSTEPS, float(action[0])
        for _ in range(SUBSTEPS):  # classical Runge-Kutta method (RK4)
            k1 = self._rates(self.motion, torque)
            k2 = self._rates(self.motion + dt / 2 * k1, torque)
            k3 = self._rates(self.motion + dt / 2 * k2, torque)
            k4 = self._rates(self.motion + dt * k3, torque)
            self.motion = self.motion + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _rates(self, motion: NDArray[np.float64], torque: float) -> NDArray[np.float64]:
        """Time derivatives of angle and velocity: m l² θ″ = −m g l sin θ − c θ′ + torque."""
        angle, velocity = motion
        pull = -MASS * GRAVITY * self.length * np.sin(angle)
        total = pull - self.damping * velocity + torque
        return np.array([velocity, total / (MASS * self.length**2)])

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        return draw(self.frame_size, float(self.motion[0]), self.length)

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"angle": self.motion[0].copy(), "velocity": self.motion[1].copy()}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return ()  # there is nothing to touch

    def policy(self, rng: np.random.Generator) -> Policy:
        """Torques of random strength, each held for 3 to 15 frames."""

        def torques() -> Iterator[NDArray[np.float64]]:
            while True:
                torque = rng.uniform(-MAX_TORQUE, MAX_TORQUE, 1)
                for _ in range(rng.integers(3, 16)):
                    yield torque

        return torques().__next__
