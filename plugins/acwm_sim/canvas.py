"""The arrays behind one view of a scene: the baked static parts, and each frame drawn on top."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from acwm_sim import view
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.engine import Launcher
from acwm_sim.kernels.clear_frame import draw_clear
from acwm_sim.kernels.opaque_frame import draw_frame, measure_tiles
from acwm_sim.kernels.raster import FAR
from acwm_sim.kernels.transparency import LAYERS
from acwm_sim.parts import Parts

_GAMMA = (255 * (np.arange(16384) / 16383) ** (1 / 2.2) + 0.5).astype(np.uint8)


class Canvas:
    """One view of static and moving parts: `bake` once, then `draw` every frame.

    Args:
        static: parts that do not move.
        moving: parts that take a pose.
        size: frame size (H, W).
        rate: samples along each side of a pixel. None chooses 2 to 4, for about 384 samples across
            the frame.
    """

    def __init__(
        self, static: Parts, moving: Parts, size: tuple[int, int], rate: int | None = None
    ) -> None:
        self.rate = rate or min(4, max(2, math.ceil(384 / min(size))))
        self._static, self._moving, self._size = static, moving, size
        self._grid = (size[0] * self.rate, size[1] * self.rate)
        self._texels = int(min(1024, max(448, max(self._grid))))
        self._side = self.rate * max(1, min(size) // 64)
        self._cell = 2 if self.rate % 2 == 0 else self.rate  # samples along a cell of a fluid
        self._cover = tuple(math.ceil(g / self._side) for g in self._grid)

    def bake(
        self, camera: Camera, light: Light, focus: tuple[Vec3, float], ao_radius: float
    ) -> None:
        """Draw the static parts and keep their samples, shadows, frame and mask."""
        self._view = view.pack(camera, light, self._grid, focus, self._texels, self.rate, ao_radius)
        self._clear = self._static.clear or self._moving.clear
        self._make_arrays()
        still = np.zeros((len(self._static), 12), np.float32)
        still[:, 3::4] = 1
        points, bounds = _projected(self._static)
        self._still_points = points
        self._draw(draw_frame, self._static, still, points, bounds, True)
        for array in (self._depth, self._surface, self._label, self._shadow[:2]):
            array[1] = array[0]
        if self._clear:
            self._base[1] = self._base[0]
            self._bare[:] = self._mask
            self._shadow[5:7] = self._shadow[2:4]
            self._lay(draw_clear, Parts(), *_projected(Parts()))
        self._background = self._frame.copy(), self._mask.copy()
        measure_tiles(self._view, self._depth, self._surface, self._side, self._still)
        self._tiles[:] = 0

    def draw(self, pose: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The frame [H, W, 3] and mask [H, W] with the moving parts at `pose` [N, 12]."""
        self._frame[:], self._mask[:] = self._background
        if len(self._moving):
            self._pose[:] = pose
            np.copyto(self._shadow[0], self._shadow[1])
            if self._moving.fluid is not None:
                view.pack_fluid(self._view, self._moving.fluid)
            if self._clear:
                np.copyto(self._shadow[2:4], self._shadow[5:7])
                self._shadow[4] = 0
            self._draw(
                self._draw_frame, self._moving, self._pose, self._points, self._bounds, False
            )
        return self._frame.copy(), self._mask.copy()

    def _make_arrays(self) -> None:
        (rows, columns), (height, width), texels = self._grid, self._size, self._texels
        self._depth = np.full((2, rows, columns), FAR, np.float32)
        self._surface = np.zeros((2, rows, columns, 7), np.float32)
        self._label = np.zeros((2, rows, columns), np.int32)
        self._still = np.zeros((*self._cover, 7), np.float32)
        self._deep = np.zeros((*self._cover, 4), np.float32)
        self._tiles = np.ones(self._cover, np.int32)
        self._marks = np.zeros(self._cover, np.int32)
        self._cells = np.zeros((64, 64), np.int32)
        self._frame = np.zeros((height, width, 3), np.uint8)
        self._mask = np.zeros((height, width), np.uint8)
        self._shadow = np.full((LAYERS if self._clear else 2, texels, texels), FAR, np.float32)
        self._base = np.zeros((2, height, width, 3) if self._clear else (1, 1, 1, 3), np.float32)
        self._bare = np.zeros_like(self._mask)
        if self._clear:
            self._shadow[3:5] = 0
            self._pool = np.zeros((4, rows // self._cell, columns // self._cell), np.float32)
            self._pool[::2] = FAR
            self._panes = np.zeros((2, height, width, 6), np.float32)
            self._front = np.full((2, rows, columns), FAR, np.float32)
            self._glow = np.empty((len(self._moving.vertices), 6), np.float32)
            self._still_glow = np.empty((len(self._static.vertices), 6), np.float32)
        self._pose = np.zeros((len(self._moving), 12), np.float32)
        self._points, self._bounds = _projected(self._moving)
        self._draw_frame, self._draw_clear = Launcher(draw_frame), Launcher(draw_clear)

    def _draw(
        self,
        launch: Callable[..., None],
        parts: Parts,
        pose: NDArray[np.float32],
        points: NDArray[np.float32],
        bounds: NDArray[np.float32],
        everything: bool,
    ) -> None:
        self._deep[..., ::2], self._deep[..., 1::2] = FAR, -FAR
        self._marks.fill(0)
        self._cells.fill(0)
        launch(
            self._view,
            parts.table,
            pose,
            parts.vertices,
            parts.triangles,
            parts.balls,
            points,
            bounds,
            self._depth,
            self._surface,
            self._label,
            self._shadow,
            self._still,
            self._tiles,
            self._marks,
            self._deep,
            self._cells,
            _GAMMA,
            self._base,
            self._bare,
            self._frame,
            self._mask,
            self._side,
            self.rate,
            1 if everything else 1 + len(self._static),
            int(everything),
        )
        if self._clear and not everything:
            self._lay(self._draw_clear, parts, points, bounds)

    def _lay(
        self,
        launch: Callable[..., None],
        parts: Parts,
        points: NDArray[np.float32],
        bounds: NDArray[np.float32],
    ) -> None:
        """Draw glass and fluid over a frame whose opaque parts are drawn."""
        launch(
            self._view,
            parts.table,
            parts.vertices,
            parts.triangles,
            parts.balls,
            points,
            bounds,
            self._glow,
            self._static.table,
            self._static.vertices,
            self._static.triangles,
            self._still_points,
            self._still_glow,
            self._depth,
            self._shadow,
            self._base,
            self._pool,
            self._panes,
            self._front,
            self._tiles,
            _GAMMA,
            self._frame,
            self._mask,
            self._side,
            self._cell,
            self.rate,
        )


def _projected(parts: Parts) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Room for the `points` and the `bounds` of parts."""
    return np.empty((len(parts.vertices), 9), np.float32), np.empty((len(parts), 9), np.float32)
