"""A scene: what stands still, what moves, one camera, one light; frames and masks come out."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_sim import engine, view
from acwm_sim.camera import Camera, Light, Vec3, linear
from acwm_sim.frame import draw_frame
from acwm_sim.meshes import Mesh
from acwm_sim.parts import VISIBLE, Parts
from acwm_sim.raster import FAR
from acwm_sim.tiles import measure_tiles

_GAMMA = (255 * (np.arange(16384) / 16383) ** (1 / 2.2) + 0.5).astype(np.uint8)


class Scene:
    """Draws frames of static and moving parts.

    Add every part, then call `render` once per frame. The static parts, with their light, shadows
    and occlusion, are drawn once; each frame redraws only what moving parts can change. A frame
    depends on nothing but the scene and its poses, never on the frames drawn before.

    Args:
        camera: the eye; `set_camera` changes it.
        light: sun and sky; `set_light` changes it.
        size: frame size (H, W); framing and anti-aliasing do not depend on it.
        focus: centre and radius in metres of the ball in which shadows fall.
        ao_radius: reach of ambient occlusion in metres.
        rate: samples along each side of a pixel; by default about 384 across the frame, from 2 to
            4, so that a small frame looks like a large one that was averaged down.
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
        self.rate = rate or min(4, max(2, math.ceil(384 / min(size))))
        self._static, self._moving = Parts(), Parts()
        self._grid = (size[0] * self.rate, size[1] * self.rate)
        self._texels = int(min(1024, max(448, max(self._grid))))
        self._side = self.rate * max(1, min(size) // 64)
        self._cover = tuple(math.ceil(g / self._side) for g in self._grid)
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
        balls = self._moving.balls_of(part)
        balls[:, :3], balls[:, 3] = centers, radius

    def set_sphere_colors(self, part: int, colors: ArrayLike) -> None:
        """Paint every sphere of a group: display colours [P, 3]."""
        self._moving.balls_of(part)[:, 4:7] = linear(np.asarray(colors, np.float32))

    def set_vertices(self, part: int, vertices: ArrayLike, normals: ArrayLike) -> None:
        """Deform a moving mesh: vertices and normals, each [V, 3], in the part's frame."""
        rows = self._moving.verts_of(part)
        rows[:, :3], rows[:, 3:6] = vertices, normals

    def set_color(self, part: int, color: Vec3) -> None:
        """Repaint a moving part with one display colour."""
        self._moving.verts_of(part)[:, 6:9] = linear(color)
        self._moving.balls_of(part)[:, 4:7] = linear(color)

    def set_visible(self, part: int, visible: bool) -> None:
        """Show or hide a moving part; a hidden one casts no shadow."""
        self._moving.table[part, VISIBLE] = visible

    def set_light(self, light: Light) -> None:
        """Change the light; the static scene is drawn anew if it differs."""
        self._baked = self._baked and light == self.light
        self.light = light

    def set_camera(self, camera: Camera) -> None:
        """Look from elsewhere; the static scene is drawn anew if the camera differs."""
        self._baked = self._baked and camera == self.camera
        self.camera = camera

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
            pose = np.empty((len(self._moving), 12), np.float32)
            pose[:, :3] = positions
            pose[:, 3:] = np.reshape(rotations, (-1, 9))
            np.copyto(self._shadow[0], self._shadow[1])
            self._draw(self._moving, pose, 1 + len(self._static), frame, mask, everything=False)
        return frame, mask

    def _bake(self) -> None:
        """Draw the static parts, and keep samples, shadows, frame and mask."""
        (rows, columns), texels = self._grid, self._texels
        self._view = view.pack(
            self.camera, self.light, self._grid, self.focus, texels, self.rate, self.ao_radius
        )
        self._depth = np.full((2, rows, columns), FAR, np.float32)
        self._surface = np.zeros((2, rows, columns, 7), np.float32)
        self._label = np.zeros((2, rows, columns), np.int32)
        self._shadow = np.full((2, texels, texels), FAR, np.float32)
        self._lit = np.zeros((*self._cover, 4), np.float32)
        self._tiles = np.ones(self._cover, np.int32)
        self._frame = np.zeros((*self.size, 3), np.uint8)
        self._mask = np.zeros(self.size, np.uint8)
        still = np.zeros((len(self._static), 12), np.float32)
        still[:, 3::4] = 1
        self._draw(self._static, still, 1, self._frame, self._mask, everything=True)
        for array in (self._depth, self._surface, self._label, self._shadow):
            array[1] = array[0]
        measure_tiles(self._view, self._depth, self._side, self._lit)
        self._tiles[:] = 0
        self._baked = True

    def _draw(
        self,
        parts: Parts,
        pose: NDArray[np.float32],
        first: int,
        frame: NDArray[np.uint8],
        mask: NDArray[np.uint8],
        *,
        everything: bool,
    ) -> None:
        draw_frame(
            self._view,
            parts.table,
            pose,
            parts.vertices,
            parts.triangles,
            parts.balls,
            np.empty((len(parts.vertices), 9), np.float32),
            np.empty((len(parts), 9), np.float32),
            self._depth,
            self._surface,
            self._label,
            self._shadow,
            self._lit,
            self._tiles,
            _GAMMA,
            frame,
            mask,
            self._side,
            self.rate,
            first,
            int(everything),
        )
