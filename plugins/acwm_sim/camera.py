"""The camera and the light of a scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera as Camera
from acwm_core.env.camera import Vec3 as Vec3


def linear(color: Vec3 | NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert a display colour (gamma 2.2, 0 to 1) to linear light, used for all shading."""
    return np.asarray(color, np.float32) ** np.float32(2.2)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


@dataclass(frozen=True)
class Light:
    """A sun that casts soft shadows, and uniform ambient light that casts none.

    Attributes:
        direction: direction towards the sun, of any length.
        sun: linear colour of sunlight on a surface that faces it.
        sky: linear colour of the ambient light from above.
        bounce: linear colour of the ambient light from below.
        softness: half width in metres of the blur at a shadow's edge.
        background: display colour where nothing is drawn.
    """

    direction: Vec3 = (0.35, -0.45, 1.2)
    sun: Vec3 = (0.78, 0.76, 0.72)
    sky: Vec3 = (0.33, 0.35, 0.40)
    bounce: Vec3 = (0.20, 0.19, 0.18)
    softness: float = 0.006
    background: Vec3 = (0.62, 0.70, 0.80)

    @property
    def basis(self) -> NDArray[np.float32]:
        """[3, 3]; rows: two directions perpendicular to the light, and the light's direction."""
        towards = _unit(np.asarray(self.direction, np.float64))
        side = (0.0, 1.0, 0.0) if abs(towards[1]) < 0.9 else (1.0, 0.0, 0.0)
        across = _unit(np.cross(side, towards))
        return np.stack([across, np.cross(towards, across), -towards]).astype(np.float32)
