"""A simple environment without simulator, a disc moved by actions, and its estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, Policy, StateField
from acwm_core.env.episode import Factor, FactorValue
from acwm_core.env.physics import (
    Constant,
    Gap,
    Level,
    Observation,
    Physics,
    StateEstimator,
    States,
    readings_of,
)
from acwm_core.env.symmetry import Symmetry, group
from acwm_core.errors import ShapeError
from acwm_core.model.shapes import Clip

RADIUS = 0.1  # in m; a frame is 1 m high
WALL = 0.25  # in m from the middle

GAIN = Factor.continuous(
    "gain", "speed at an action of 1", train=(0.8, 1.0), ood=((1.5, 2.0),), nominal=0.9, active=True
)
SHADE = Factor.discrete("shade", "background", train=("light",), ood=("dark",), nominal="light")


class Disc(Environment):
    """The environment on which metrics are checked if their own plugin has none."""

    card = EnvironmentCard(
        name="disc",
        summary="A disc that moves by its actions.",
        action=ActionSpec(("vx", "vy"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "delta"),
        frame_size=(128, 192),
        fps=10,
        horizon=24,
        factors=(GAIN, SHADE),
        ood_shifts=("gain", "shade"),
        state=(
            StateField(
                "position", (2,), "m", "from the middle of the frame, y down", "position", ("disc",)
            ),
            StateField(
                "bearing", (), "rad", "direction of the position, from x to y", "angle", ("disc",)
            ),
        ),
        instances=("background", "disc"),
        engine="numpy",
        symmetries=group(
            Symmetry((-1, 2), mirrored=True),
            Symmetry((2, -1), quarter_turns=1),  # y is down
        ),
        camera=Camera.flat(0.5, down=True),
    )

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self.gain, self.shade = float(factors["gain"]), factors["shade"]
        self.position = rng.uniform(-0.2, 0.2, 2)

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        self.position = self.position + amount * rng.normal(0, 1e-3, 2)

    def _transform(self, symmetry: Symmetry) -> None:
        self.position = self.position @ (symmetry.plane * [[1, -1], [-1, 1]]).T  # y is down

    def _snapshot(self) -> Callable[[], None]:
        position = self.position.copy()

        def back() -> None:
            self.position = position.copy()

        return back

    def _advance(self, action: NDArray[np.float32]) -> None:
        self.position = np.clip(self.position + self.gain * action / self.card.fps, -WALL, WALL)

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        height, width = self.frame_size
        y, x = np.indices(self.frame_size) + 0.5
        x, y = (x - width / 2) / height, (y - height / 2) / height
        distance = np.hypot(x - self.position[0], y - self.position[1]) - RADIUS
        covered = np.clip(0.5 - distance * height, 0, 1)[..., None]
        background = 200 if self.shade == "light" else 60
        frame = background + covered * (np.array([220, 40, 40]) - background)
        return frame.astype(np.uint8), (distance < 0).astype(np.uint8)

    def _state(self) -> dict[str, NDArray[Any]]:
        x, y = self.position
        return {"position": self.position.copy(), "bearing": np.arctan2(y, x)}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return [(0, 1)] if np.abs(self.position).max() >= WALL else []

    def policy(self, rng: np.random.Generator) -> Policy:
        """Random velocities."""
        return lambda: rng.uniform(-1, 1, 2)


class DiscEstimator(StateEstimator):
    """Finds the red pixels: the estimator with which physics metrics are checked."""

    fields = ("position", "bearing")
    instances = ("disc",)

    @property
    def physics(self) -> Physics:
        """One disc of constant size between walls."""
        return Physics(
            readings=readings_of(Disc.card.state, "position", "bearing"),
            objects=("disc",),
            shapes=("disc",),
            levels=(Level("disc", _height),),
            constants=(
                Constant("diameter", "length", _diameter, 0.1),
                Constant("area", "amount", _area, 0.2),
            ),
            gaps=(Gap("wall", ("background", "disc"), _to_wall, touch=0.004, solid=0.02),),
        )

    def estimate(self, video: Clip) -> Observation:
        """Masks, and the centre of the disc's pixels; NaN where there are none."""
        if tuple(video.shape[2:]) != self.card.frame_size:
            raise ShapeError(f"frames are {[*video.shape[2:]]}, not {self.card.frame_size}")
        red = avg_pool2d(video[:, 0] - video[:, 1], 5, 1, 2, count_include_pad=False).numpy()
        masks = (red > 0.35).astype(np.uint8)  # the value at the disc's edge
        rows, columns = np.indices(masks.shape[1:]) + 0.5
        pixels = masks.sum((1, 2))
        height, width = masks.shape[1:]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = ((masks * columns).sum((1, 2)) / pixels - width / 2) / height
            y = (masks * rows).sum((1, 2)) / pixels / height - 0.5
        position = np.stack([x, y], 1).astype(np.float32)
        return Observation(masks, {"position": position, "bearing": np.arctan2(y, x)})

    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """Convert metres to pixels: a frame is 1 m high, with the origin in its middle."""
        height, width = self.card.frame_size
        return np.asarray(values, np.float64) * height + np.array([width, height]) / 2


def _height(seen: Observation, start: States) -> NDArray[np.float64]:
    return -np.asarray(seen.states["position"], np.float64)[:, 1:]


def _area(seen: Observation, start: States) -> NDArray[np.float64]:
    """The disc's area in m²."""
    height = seen.masks.shape[1]
    return (seen.masks == 1).sum((1, 2)) / float(height) ** 2


def _diameter(seen: Observation, start: States) -> NDArray[np.float64]:
    return 2 * np.sqrt(_area(seen, start) / np.pi)


def _to_wall(seen: Observation, start: States) -> NDArray[np.float64]:
    """How far the centre of the disc can still move in m; it stops at WALL."""
    return WALL - np.abs(np.asarray(seen.states["position"], np.float64)).max(1)
