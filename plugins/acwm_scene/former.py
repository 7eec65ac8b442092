"""The models that scenes replaced, so that runs of earlier versions are still read.

Their recipes name what an environment's card declares today: counts, folds, the camera.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

from acwm_core.env.camera import Camera, Vec3
from acwm_core.errors import AcwmWarning
from acwm_core.model.dynamics import ModelInputs
from acwm_scene.declared import GroupSpec
from acwm_scene.scene import SceneDynamics


class Former(SceneDynamics):
    """A scene of one group, described by its recipe.

    Args:
        former: its name in earlier versions.
        spec: the group.
        **sizes: see `SceneDynamics`.
    """

    def __init__(self, former: str, spec: GroupSpec, **sizes: Any) -> None:
        warnings.warn(
            f"model={former} of earlier versions is read as a scene; new models are model=scene, "
            "for which the environment's card says the rest",
            AcwmWarning,
            stacklevel=3,
        )
        super().__init__(specs={spec.kind: spec}, state_size=len(spec.columns), **sizes)

    @classmethod
    def fitted(cls, data: ModelInputs) -> dict[str, Any]:
        """The codec's facts, and the number of values of the states."""
        state = data.environment.state if data.environment else ()
        fields = {field.name: math.prod(field.shape) for field in state}
        return {
            "latent_channels": data.latent_channels,
            "temporal_stride": data.temporal_stride,
            "state_size": sum(fields[name] for name in data.states),
        }


class PlanarBodies(Former):
    """Bodies on a plane, seen from above, `view` metres from the middle to the upper edge."""

    def __init__(
        self,
        *,
        latent_channels: int,
        temporal_stride: int = 4,
        state_size: int = 0,
        agents: int = 1,
        bodies: int = 5,
        folds: int = 4,
        unit: float = 0.08,
        view: float = 0.335,
        channels: int = 96,
        width: int = 192,
        blocks: int = 4,
        noise: int = 0,
    ) -> None:
        state_size = state_size or 2 * agents + 4 * bodies
        above = Camera.flat(view)
        spec = GroupSpec(
            "bodies",
            tuple(range(state_size)),
            agents=agents,
            bodies=bodies,
            folds=folds,
            has_presence=True,
            axes=(state_size - 2 * agents - 2 * bodies) // bodies,
            camera=above,
        )
        super().__init__(
            "planar_bodies",
            spec,
            latent_channels=latent_channels,
            temporal_stride=temporal_stride,
            unit=unit,
            channels=channels,
            width=width,
            blocks=blocks,
            noise=noise,
        )


class DrawnStates(Former):
    """Values, of which the last ones follow from the others."""

    def __init__(
        self,
        *,
        latent_channels: int,
        temporal_stride: int = 4,
        state_size: int = 1,
        following: int = 0,
        channels: int = 96,
        width: int = 192,
        blocks: int = 4,
    ) -> None:
        super().__init__(
            "drawn_states",
            GroupSpec("values", tuple(range(state_size)), following),
            latent_channels=latent_channels,
            temporal_stride=temporal_stride,
            channels=channels,
            width=width,
            blocks=blocks,
        )


class FlexibleBody(Former):
    """The nodes of a rope or a cloth."""

    def __init__(
        self,
        *,
        latent_channels: int,
        temporal_stride: int = 4,
        state_size: int = 0,
        agents: int = 1,
        nodes: Sequence[int] = (80,),
        every: int = 2,
        unit: float = 0.1,
        eye: Sequence[float] = (0.0, -2.2, 4.0),
        target: Sequence[float] = (0.0, -0.08, 0.0),
        fov: float = 33.5,
        light: Sequence[float] | None = None,
        stretch: float | None = None,
        channels: int = 96,
        motion_channels: int = 64,
        width: int = 192,
        blocks: int = 4,
    ) -> None:
        state_size = state_size or 2 * (agents + math.prod(nodes))
        spec = GroupSpec(
            "nodes",
            tuple(range(state_size)),
            agents=agents,
            axes=state_size // (agents + math.prod(nodes)),
            nodes=tuple(nodes),
            camera=Camera(_vector(eye), _vector(target), fov=fov),
            light=None if light is None else _vector(light),
        )
        super().__init__(
            "flexible_body",
            spec,
            latent_channels=latent_channels,
            temporal_stride=temporal_stride,
            stretch=stretch,
            unit=unit,
            every=every,
            channels=channels,
            width=width,
            blocks=blocks,
        )


def _vector(values: Sequence[float]) -> Vec3:
    x, y, z = values
    return x, y, z
