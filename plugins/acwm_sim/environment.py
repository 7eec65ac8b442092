"""`SceneEnvironment`: the base class of environments whose frames are drawn by a `Scene`."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.episode import Factor, FactorValue
from acwm_core.errors import RecipeError
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.scene import Scene

Simulation = TypeVar("Simulation")
"""The type of the simulation of one episode."""

Factors = Mapping[str, FactorValue]
"""The values of an episode's factors, by name."""

Frame = tuple[NDArray[np.uint8], NDArray[np.uint8]]
"""A frame `[H, W, 3]` and its mask `[H, W]`."""


def appearance(name: str, description: str, usual: str, *others: str) -> Factor:
    """A factor of appearance: one value in training, the others out of distribution."""
    return Factor.discrete(name, description, train=(usual,), ood=others, nominal=usual)


LIGHT = appearance("light", "sun and sky", "noon", "evening", "overcast")


class Drawing(ABC, Generic[Simulation]):
    """Draws the simulations of an environment, caching the static parts per camera and light.

    Args:
        size: frame size (H, W).

    Attributes:
        cameras: cameras by value of the factor `camera`, the nominal one first.
        lights: lights by value of the factor `light`, the nominal one first.
        focus: centre and radius in metres of the ball in which shadows are drawn.
        ao_radius: reach of ambient occlusion in metres.
        scene: the scene that is drawn.
    """

    cameras: ClassVar[Mapping[str, Camera]]
    lights: ClassVar[Mapping[str, Light]]
    focus: ClassVar[tuple[Vec3, float]]
    ao_radius: ClassVar[float]

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._clear()
        self._build()

    def _clear(self) -> None:
        """Start with a new, empty scene."""
        camera, light = next(iter(self.cameras.values())), next(iter(self.lights.values()))
        self.scene = Scene(camera, light, self.size, self.focus, ao_radius=self.ao_radius)

    @abstractmethod
    def _build(self) -> None:
        """Add all parts to the scene."""

    @abstractmethod
    def _dress(self, simulation: Simulation, factors: Factors) -> None:
        """Set the sizes and colours of the parts for an episode."""

    @abstractmethod
    def draw(self, simulation: Simulation) -> Frame:
        """Draw the frame and mask of the current state."""

    def dress(self, simulation: Simulation, factors: Factors) -> None:
        """Apply the factors of an episode that change the appearance."""
        self._dress(simulation, factors)
        self.scene.set_light(self.lights[str(factors["light"])])
        if "camera" in factors:
            self.scene.set_camera(self.cameras[str(factors["camera"])])


class SceneEnvironment(Environment, Generic[Simulation]):
    """An environment that builds a simulation for every episode and draws it.

    A subclass implements `_begin` instead of `_start`, and does not implement `_render`. A
    simulation with a `close` method is closed when the next one starts; one with a `snapshot`
    method gives the environment's snapshots (see `Environment._snapshot`).

    Attributes:
        drawn_by: the class that draws the simulations.
        limits: lowest and highest values of factors that the simulation accepts.
    """

    drawn_by: ClassVar[type[Drawing[Any]]]
    limits: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def __init__(
        self,
        *,
        size: int | tuple[int, int] | None = None,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        super().__init__(size=size, render_mode=render_mode)
        self._simulation: Simulation | None = None

    @abstractmethod
    def _begin(self, factors: Factors, rng: np.random.Generator) -> Simulation:
        """Build the simulation of an episode; all randomness must come from `rng`."""

    @functools.cached_property
    def drawing(self) -> Drawing[Simulation]:
        """Draws the simulations. It is made when it is first used: a process that only asks for
        spaces, such as the parent of Gymnasium's `AsyncVectorEnv`, may fork afterwards."""
        return self.drawn_by(self.frame_size)

    @property
    def simulation(self) -> Simulation:
        """The simulation of the current episode."""
        assert self._simulation is not None, "reset() comes first"
        return self._simulation

    @simulation.setter
    def simulation(self, simulation: Simulation) -> None:
        self._free()
        self._simulation = simulation

    def _free(self) -> None:
        close: Callable[[], None] | None = getattr(self._simulation, "close", None)
        if close:
            close()
        self._simulation = None

    def close(self) -> None:
        self._free()

    def _start(self, factors: Factors, rng: np.random.Generator) -> None:
        check_limits(factors, self.limits)
        self.simulation = self._begin(factors, rng)
        self.drawing.dress(self.simulation, factors)

    def _snapshot(self) -> Callable[[], None] | None:
        take: Callable[[], Callable[[], None]] | None = getattr(self.simulation, "snapshot", None)
        return None if take is None else take()

    def _render(self) -> Frame:
        return self.drawing.draw(self.simulation)

    def clipped(self, next_action: Callable[[], NDArray[np.floating[Any]]]) -> Policy:
        """A policy that clips actions to their bounds."""
        low, high = self.card.action.low, self.card.action.high
        return lambda: np.clip(next_action(), low, high)


def check_limits(
    factors: Mapping[str, FactorValue], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Reject factor values that a simulator cannot handle.

    Args:
        factors: values by name.
        limits: lowest and highest allowed value of continuous factors, by name.

    Raises:
        RecipeError: a value lies outside its limits.
    """
    for name, (low, high) in limits.items():
        value = float(factors[name])
        if not low <= value <= high:
            raise RecipeError(f"factors.{name}={value:g}: give {low:g} to {high:g}")
