"""pour_water: a held cup pours water into a container on a table."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_particle.cup import Cup, Vessel
from acwm_particle.physics import CONTAINER, CUP
from acwm_particle.states import POUR_WATER_STATE, SUN, WATER_CAMERA, WATER_RECORDED
from acwm_particle.water import FRAME, Water
from acwm_particle.water_drawing import CONTAINER_ID, CUP_ID, WATER_ID, WaterDrawing
from acwm_particle.water_policy import Pourer
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

_SETTLING = 8  # frames before frame 0 in which the water comes to rest in the cup

_FACTORS = (
    Factor.continuous(
        "water_level",
        "how high the cup is filled at first",
        train=(0.50, 0.70),
        ood=((0.20, 0.32), (0.86, 0.98)),
        nominal=0.60,
        unit="m",
        active=True,
    ),
    Factor.continuous(
        "viscosity",
        "how fast neighbouring water takes on the same velocity",
        train=(3.0, 6.0),
        ood=((40.0, 80.0),),
        nominal=4.0,
        unit="1/s",
    ),
    Factor.continuous(
        "container_radius",
        "inner radius of the container",
        train=(0.64, 0.72),
        ood=((0.54, 0.58), (0.80, 0.86)),
        nominal=0.68,
        unit="m",
    ),
    appearance("colors", "colour of the water", "sea", "amber", "berry", "mint"),
    LIGHT,
    appearance("camera", "where it looks from", "front", "left", "high"),
)

_LIMITS = {
    "water_level": (0.1, 1.15),
    "viscosity": (0.0, 1000.0),
    "container_radius": (0.35, 0.95),
}
"""The factor values that the simulation accepts."""

_ACTION = ActionSpec(
    names=("delta_x", "delta_y", "delta_z", "delta_tilt"),
    units=("m", "m", "m", "rad"),
    low=(-0.08, -0.06, -0.08, -0.12),
    high=(0.08, 0.06, 0.08, 0.12),
    kind="delta",
)


class PourWater(SceneEnvironment[Water]):
    """Water in a glass cup, and a glass container on a table to pour it into.

    The action moves the target of the cup along the world axes in metres (+x right, +y away from
    the camera, +z up) and tilts it towards +x in radians. The cup follows like a critically damped
    spring; a zero action lets it come to rest; container and table stop it. The world is about a
    metre in size (the cup is 1.2 m tall). The 300 frames of an episode last 30 seconds. The water
    starts at rest in the cup and adds no weight to it. A collision changes its velocity by at most
    2 m/s per substep. The contact between container and table is not listed.
    """

    drawn_by = WaterDrawing
    limits = _LIMITS
    card = EnvironmentCard(
        name="pour_water",
        summary="A held cup pours water into a container on a table.",
        action=_ACTION,
        frame_size=(240, 240),
        fps=round(1 / FRAME),
        horizon=300,
        factors=_FACTORS,
        ood_shifts=("water_level",),
        state=POUR_WATER_STATE,
        instances=("table", "cup", "container", "water", "holder"),
        engine="Taichi (position-based fluids)",
        episodes={"train": 1000, "ind_test": 50, "ood_test": 50},
        citation="ACWM-Phys, arXiv:2605.08567",
        camera=WATER_CAMERA,
        light=SUN,
    )

    def _begin(self, factors: Factors, rng: np.random.Generator) -> Water:
        container = Vessel(float(factors["container_radius"]), CONTAINER.tall)
        place = np.array([rng.uniform(0.5, 0.7), rng.uniform(-0.12, 0.12)])
        pose = rng.uniform([-1.25, -0.2, 1.0, 0.0], [-1.0, 0.2, 1.45, 0.0])
        level, viscosity = float(factors["water_level"]), float(factors["viscosity"])
        water = Water(Cup(CUP, container, place, pose), level, viscosity, rng)
        water.settle(_SETTLING)
        return water

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move and tilt the cup together with its water."""
        shift = amount * rng.normal(0, 1e-3, 4)
        while not self.simulation.displace(shift):
            shift /= 2

    def _advance(self, action: NDArray[np.float32]) -> None:
        self.simulation.advance(action.astype(np.float64))

    def _state(self) -> dict[str, NDArray[Any]]:
        water, cup = self.simulation, self.simulation.cup
        chosen = np.arange(WATER_RECORDED) % len(water.particles)
        speeds = (water.velocities.astype(np.float64) ** 2).sum(1)
        return {
            "water_position": water.numbered[chosen].astype(np.float16),
            "water_count": np.array([len(water.particles)], np.int32),
            "water_share": water.shares().astype(np.float32),
            "water_center": water.particles.mean(0, dtype=np.float64).astype(np.float32),
            "water_speed": np.array([np.sqrt(speeds.mean())], np.float32),
            "cup_pose": cup.pose.astype(np.float32),
            "cup_velocity": cup.velocity.astype(np.float32),
            "cup_target": cup.target.astype(np.float32),
            "container_position": np.array([*cup.place, 0.0], np.float32),
        }

    def _contacts(self) -> Iterable[tuple[int, int]]:
        cup, (in_cup, in_container, on_table) = self.simulation.cup, self.simulation.touches
        pairs = {
            (CUP_ID, WATER_ID): in_cup,
            (CONTAINER_ID, WATER_ID): in_container,
            (0, WATER_ID): on_table,
            (CUP_ID, CONTAINER_ID): cup.touches_container,
            (0, CUP_ID): cup.touches_table,
        }
        return [pair for pair, touching in pairs.items() if touching]

    def policy(self, rng: np.random.Generator) -> Policy:
        """Pour in one or several steps, with pauses, corrections and exploration in between."""
        return self.clipped(Pourer(self.simulation, rng).next_action)
