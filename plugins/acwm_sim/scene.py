"""A scene of static and moving parts, with one camera and one light, drawn to frames and masks."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_sim import engine
from acwm_sim.camera import Camera, Light, Vec3, linear
from acwm_sim.canvas import Canvas
from acwm_sim.meshes import Mesh
from acwm_sim.parts import FLUID, GLASS, VISIBLE, Fluid, Parts
from acwm_sim.view import INFLATE

MAX_VIEWS = 4
"""Number of cameras for which a scene caches the static parts."""


class Scene:
    """Draws frames of static and moving parts.

    Add every part, then call `render` once per frame. The static parts, with their light, shadows
    and occlusion, are drawn once; each frame redraws only what moving parts can change. A frame
    depends only on the scene and its poses, never on earlier frames.

    Args:
        camera: the camera; `set_camera` changes it.
        light: sun and sky; `set_light` changes it.
        size: frame size (H, W); framing and anti-aliasing do not depend on it.
        focus: centre and radius in metres of the ball in which shadows are drawn.
        ao_radius: reach of ambient occlusion in metres.
        rate: samples along each side of a pixel. By default 2 to 4, for about 384 samples across
            the frame, so that a small frame looks like a large one that was averaged down.
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
        self._static, self._moving = Parts(), Parts()
        self._rate = rate
        self._canvases: dict[Camera, Canvas] = {}  # baked

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
            mesh: in its own coordinates, or in world coordinates if static.
            color: display colour, 0 to 1, used if the mesh has no colours of its own.
            static: whether it never moves. Static parts take no pose.
            instance: id in the mask, 0 to 255.
            gloss: strength of the highlight.
            solid: whether it is closed, so that only its outside shows; False for sheets such as
                cloth.

        Returns:
            The number of the part: its row in `render`'s poses if it moves.
        """
        self._canvases.clear()
        parts = self._static if static else self._moving
        return parts.add_mesh(mesh, color, gloss, instance, solid)

    def add_spheres(
        self, count: int, color: Vec3 = (0.8, 0.8, 0.8), *, instance: int = 0, gloss: float = 0.1
    ) -> int:
        """Add a group of moving spheres (exact, not meshes); place them with `set_spheres`."""
        self._canvases.clear()
        return self._moving.add_spheres(count, color, gloss, instance)

    def set_spheres(self, part: int, centers: ArrayLike, radius: ArrayLike) -> None:
        """Place a group of spheres: world centres [P, 3] and radius (one or [P]) in metres."""
        balls = self._moving.balls_of(part)
        balls[:, :3], balls[:, 3] = centers, radius

    def set_sphere_colors(self, part: int, colors: ArrayLike) -> None:
        """Paint every sphere of a group: display colours [P, 3]."""
        self._moving.balls_of(part)[:, 4:7] = linear(np.asarray(colors, np.float32))

    def add_glass(
        self,
        mesh: Mesh,
        color: Vec3 = (0.97, 0.985, 0.99),
        *,
        static: bool = False,
        instance: int = 0,
    ) -> int:
        """Add thin, transparent glass. Every surface of the mesh tints and mirrors.

        In the mask it takes only pixels that would be 0 without it: parts in it or behind it keep
        their own id.

        Args:
            mesh: in its own coordinates, or in world coordinates if static. A vessel has two
                walls, an inner and an outer one.
            color: display colour of white light after one surface, seen head-on. Slanting light has
                a longer path and loses more, by the Beer–Lambert law.
            static: whether it never moves.
            instance: id in the mask, 0 to 255.

        Returns:
            The number of the part: its row in `render`'s poses if it moves.
        """
        self._canvases.clear()
        parts = self._static if static else self._moving
        return parts.add_mesh(mesh, color, 0.0, instance, False, GLASS)

    def add_fluid(
        self,
        color: Vec3 = (0.16, 0.47, 0.85),
        *,
        instance: int = 0,
        depth: float = 0.1,
        haze: float = 0.5,
    ) -> int:
        """Add a fluid of particles, placed by `set_fluid`. A scene can hold only one fluid.

        Args:
            color: display colour of white light after `depth` metres of fluid.
            instance: id in the mask, 0 to 255.
            depth: metres.
            haze: share of the light, 0 to 1, that `depth` metres of fluid scatter in its own
                colour; 0 is perfectly clear.

        Returns:
            The number of the part. Its row in `render`'s poses is ignored.
        """
        if self._moving.fluid is not None:
            raise ValueError("a scene holds one fluid: there is one already")
        self._canvases.clear()
        part = self._moving.add_spheres(0, color, 0.0, instance, FLUID)
        self._moving.fluid = Fluid(part, linear(color), depth, haze)
        return part

    def set_fluid(self, part: int, centers: ArrayLike, radius: float) -> None:
        """Place the particles of a fluid: world centres [P, 3]. Their number may change.

        `radius` is half their spacing at rest in metres: each represents (2 · radius)³ of fluid.
        """
        fluid = self._moving.fluid
        if fluid is None or fluid.part != part:
            raise ValueError(f"part {part} is not a fluid: add one with add_fluid")
        points = np.asarray(centers, np.float32).reshape(-1, 3)
        rows = self._moving.resize_balls(part, len(points))
        fluid.radius = radius
        rows[:, :3], rows[:, 3] = points, INFLATE * radius

    def set_vertices(self, part: int, vertices: ArrayLike, normals: ArrayLike) -> None:
        """Deform a moving mesh: vertices and normals, each [V, 3], in the part's frame."""
        rows = self._moving.verts_of(part)
        rows[:, :3], rows[:, 3:6] = vertices, normals

    def reshape(self, part: int, mesh: Mesh) -> None:
        """Give a moving mesh another shape with the same number of vertices."""
        self.set_vertices(part, mesh.vertices, mesh.normals)

    def set_color(self, part: int, color: Vec3) -> None:
        """Repaint a moving part with one display colour."""
        self._moving.verts_of(part)[:, 6:9] = linear(color)
        self._moving.balls_of(part)[:, 4:7] = linear(color)
        if self._moving.fluid is not None and self._moving.fluid.part == part:
            self._moving.fluid.color = linear(color)

    def set_visible(self, part: int, visible: bool) -> None:
        """Show or hide a moving part; a hidden one casts no shadow."""
        self._moving.table[part, VISIBLE] = visible

    def set_light(self, light: Light) -> None:
        """Change the light; if it differs, the static scene is drawn again."""
        if light != self.light:
            self._canvases.clear()
        self.light = light

    def set_camera(self, camera: Camera) -> None:
        """Change the camera. The static parts are cached for the last MAX_VIEWS cameras.

        So several cameras can take turns within a frame::

            for camera in cameras:
                scene.set_camera(camera)
                frame, mask = scene.render(positions, rotations)
        """
        self.camera = camera

    def render(
        self, positions: ArrayLike = (), rotations: ArrayLike = ()
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Draw a frame.

        Args:
            positions: [N, 3] world positions of the moving parts in metres, in the order in which
                they were added; rows of sphere groups and hidden parts are ignored.
            rotations: [N, 3, 3] rotation matrices, which may include a uniform scale.

        Returns:
            The frame [H, W, 3] and the mask of instance ids [H, W], both uint8 and new.
        """
        canvas = self._canvas()
        pose = np.zeros((len(self._moving), 12), np.float32)
        if len(self._moving):
            pose[:, :3] = positions
            pose[:, 3:] = np.reshape(rotations, (-1, 9))
        return canvas.draw(pose)

    def _canvas(self) -> Canvas:
        """The canvas of the current camera, with the static parts drawn."""
        canvas = self._canvases.pop(self.camera, None)
        if canvas is None:
            canvas = Canvas(self._static, self._moving, self.size, self._rate)
            canvas.bake(self.camera, self.light, self.focus, self.ao_radius)
        self._canvases[self.camera] = canvas  # the latest is last
        if len(self._canvases) > MAX_VIEWS:
            del self._canvases[next(iter(self._canvases))]
        return canvas
