"""A scene: what stands still, what moves, one camera, one light; frames and masks come out."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_sim import engine, raster, shading, view
from acwm_sim.camera import Camera, Light, Vec3, linear
from acwm_sim.meshes import Mesh
from acwm_sim.parts import Parts

_GAMMA = (255 * (np.arange(16384) / 16383) ** (1 / 2.2) + 0.5).astype(np.uint8)


def _disc(taps: int) -> NDArray[np.float32]:
    """Points spread evenly over the unit disc (a sunflower), [taps, 2]."""
    k = np.arange(taps) + 0.5
    angle, radius = k * math.pi * (3 - math.sqrt(5)), np.sqrt(k / taps)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]).astype(np.float32)


@dataclass
class _Samples:
    """The sample grid; see `acwm_sim.raster` for the arrays."""

    depth: NDArray[np.float32]
    surface: NDArray[np.float32]
    label: NDArray[np.int32]

    @classmethod
    def empty(cls, rows: int, columns: int) -> "_Samples":
        return cls(
            np.full((rows, columns), raster.FAR, np.float32),
            np.zeros((rows, columns, 7), np.float32),
            np.zeros((rows, columns), np.int32),
        )

    def copy(self) -> "_Samples":
        return _Samples(self.depth.copy(), self.surface.copy(), self.label.copy())

    @property
    def arrays(self) -> tuple[NDArray, NDArray, NDArray]:
        return self.depth, self.surface, self.label


class Scene:
    """Draws frames of static and moving parts.

    Add every part, then call `render` once per frame. The static parts, with their light, shadows
    and occlusion, are drawn once; each frame redraws only what moving parts can change. A frame
    depends on nothing but the scene and its poses, never on the frames drawn before.

    Args:
        camera: the eye. For another view of the same parts, make another scene.
        light: sun and sky; `set_light` changes it.
        size: frame size (H, W); framing and anti-aliasing do not depend on it.
        focus: centre and radius in metres of the ball in which shadows fall.
        ao_radius: reach of ambient occlusion in metres.
        rate: samples along each side of a pixel; by default about 480 across the frame, from 2 to
            5, so that a small frame looks like a large one that was averaged down.
    """

    def __init__(
        self,
        camera: Camera,
        light: Light,
        size: tuple[int, int],
        focus: tuple[Vec3, float],
        *,
        ao_radius: float = 0.05,
        rate: int | None = None,
    ) -> None:
        engine.start()
        self.camera, self.light, self.size, self.focus = camera, light, size, focus
        self.ao_radius = ao_radius
        self.rate = rate or min(5, max(2, math.ceil(480 / min(size))))
        self._static, self._moving = Parts(), Parts()
        self._grid = (size[0] * self.rate, size[1] * self.rate)
        self._texels = int(min(1024, max(256, max(self._grid))))
        self._side = self.rate * max(2, min(size) // 32)
        self._cover = tuple(math.ceil(g / self._side) for g in self._grid)
        self._taps = _disc(16)
        self._baked = False

    def add_mesh(
        self,
        mesh: Mesh,
        color: Vec3 = (0.8, 0.8, 0.8),
        *,
        static: bool = False,
        instance: int = 0,
        gloss: float = 0.1,
        solid: bool = True,
    ) -> int:
        """Add a mesh.

        Args:
            mesh: in its own frame, or in the world's if static.
            color: display colour, 0 to 1, where the mesh has no colours of its own.
            static: never moves. Static parts take no pose.
            instance: id in the mask, 0 to 255.
            gloss: strength of the highlight.
            solid: closed, so only its outside shows; False for sheets such as cloth.

        Returns:
            The number of the part: its row in `render`'s poses if it moves.
        """
        self._baked = False
        parts = self._static if static else self._moving
        return parts.add_mesh(mesh, color, gloss, instance, solid)

    def add_spheres(
        self, count: int, color: Vec3 = (0.8, 0.8, 0.8), *, instance: int = 0, gloss: float = 0.1
    ) -> int:
        """Add a group of moving spheres (exact, not meshes); place them with `set_spheres`."""
        self._baked = False
        return self._moving.add_spheres(count, color, gloss, instance)

    def set_spheres(self, part: int, centers: ArrayLike, radius: ArrayLike) -> None:
        """Place a group of spheres: world centres [P, 3] and radius (one or [P]) in metres."""
        chosen = self._moving.ball_owner == part
        self._moving.balls[chosen, :3] = centers
        self._moving.balls[chosen, 3] = radius

    def set_vertices(self, part: int, vertices: ArrayLike, normals: ArrayLike) -> None:
        """Deform a moving mesh: vertices and normals, each [V, 3], in the part's frame."""
        chosen = self._moving.owner == part
        self._moving.local[chosen, :3] = vertices
        self._moving.local[chosen, 3:] = normals

    def set_color(self, part: int, color: Vec3) -> None:
        """Repaint a moving part with one display colour."""
        self._moving.color[self._moving.owner == part, :3] = linear(color)
        self._moving.balls[self._moving.ball_owner == part, 4:7] = linear(color)

    def set_visible(self, part: int, visible: bool) -> None:
        """Show or hide a moving part; a hidden one casts no shadow."""
        self._moving.table[part, 2] = visible

    def set_light(self, light: Light) -> None:
        """Change the light; the static scene is drawn anew if it differs."""
        self._baked = self._baked and light == self.light
        self.light = light

    def render(
        self, positions: ArrayLike = (), rotations: ArrayLike = ()
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Draw a frame.

        Args:
            positions: [N, 3] world positions of the moving parts in metres, in the order in which
                they were added; rows of sphere groups and hidden parts are ignored.
            rotations: [N, 3, 3] rotation matrices, which may carry a uniform scale.

        Returns:
            The frame [H, W, 3] and the mask of instance ids [H, W], both uint8 and new.
        """
        if not self._baked:
            self._bake()
        frame, mask = self._frame.copy(), self._mask.copy()
        if len(self._moving):
            np.copyto(self._shadow, self._static_shadow)
            place = np.ascontiguousarray(positions, np.float32).reshape(-1, 3)
            turn = np.ascontiguousarray(rotations, np.float32).reshape(-1, 3, 3)
            bounds = self._cast(self._moving, place, turn)
            shading.mark_tiles(
                self._view, self._moving.table, bounds, self._lit, self._side, self._tiles
            )
            shading.restore_tiles(
                self._tiles, self._side, *self._static_samples.arrays, *self._samples.arrays
            )
            self._draw(self._moving, 1 + len(self._static))
            self._shade(frame, mask)
        return frame, mask

    def _bake(self) -> None:
        """Draw the static parts, and keep samples, shadows, frame and mask."""
        scale = (self.rate, self._texels)
        self._view = view.pack(
            self.camera, self.light, self._grid, self.focus, scale[1], scale[0], self.ao_radius
        )
        self._samples = _Samples.empty(*self._grid)
        self._shadow = np.full((self._texels, self._texels), raster.FAR, np.float32)
        if len(self._static):
            count = len(self._static)
            still = np.zeros((count, 3), np.float32)
            upright = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))
            self._cast(self._static, still, upright)
            self._draw(self._static, 1)
        self._static_samples, self._static_shadow = self._samples.copy(), self._shadow.copy()
        self._lit = np.zeros((*self._cover, 4), np.float32)
        shading.measure_tiles(self._view, self._samples.depth, self._side, self._lit)
        self._tiles = np.ones(self._cover, np.int32)
        self._frame = np.zeros((*self.size, 3), np.uint8)
        self._mask = np.zeros(self.size, np.uint8)
        self._shade(self._frame, self._mask)
        self._tiles[:] = 0
        self._baked = True

    def _cast(self, parts: Parts, place: NDArray, turn: NDArray) -> NDArray[np.float32]:
        """Pose parts, draw their shadows; returns their bounds."""
        bounds = np.empty((len(parts), 9), np.float32)
        parts.points = np.empty((len(parts.local), 9), np.float32)
        raster.project(
            self._view, parts.local, parts.owner, place, turn, parts.table, parts.points, bounds
        )
        if len(parts.triangles):
            raster.shade_triangles(parts.points, parts.triangles, parts.table, self._shadow)
        if len(parts.balls):
            raster.shade_spheres(
                self._view, parts.balls, parts.ball_owner, parts.table, bounds, self._shadow
            )
        return bounds

    def _draw(self, parts: Parts, first: int) -> None:
        if len(parts.triangles):
            raster.draw_triangles(
                parts.points,
                parts.color,
                parts.triangles,
                parts.table,
                first,
                *self._samples.arrays,
            )
        if len(parts.balls):
            raster.draw_spheres(
                self._view,
                parts.balls,
                parts.ball_owner,
                parts.table,
                first,
                *self._samples.arrays,
            )

    def _shade(self, frame: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
        shading.shade_tiles(
            self._view,
            self._tiles,
            self._side,
            self.rate,
            *self._samples.arrays,
            self._shadow,
            self._taps,
            _GAMMA,
            frame,
            mask,
        )
