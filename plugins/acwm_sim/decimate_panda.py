"""Remake `panda.npz`, the Franka Panda with few triangles: `python -m acwm_sim.decimate_panda`.

Reads the visual meshes that the PyBullet wheel brings (Apache-2.0, `pybullet_data/franka_panda`),
simplifies each material of each link by quadric edge collapse (Garland and Heckbert 1997, from the
package fast-simplification) and writes vertices in hundredths of a millimetre, normals in bytes.
"""

from pathlib import Path

import fast_simplification
import numpy as np
import pybullet_data
from numpy.typing import NDArray

from acwm_sim.meshes import Mesh
from acwm_sim.panda_mesh import ASSET, MESHES, VERTEX_UNIT

SOURCE = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes"

KEPT = 0.3
"""Share of the triangles that stay where there are many. A 240×240 frame of the arm then differs
from one of the full meshes by more than 50 dB (`tests/sim/test_panda.py`)."""

SMALL = 4000
"""Triangles up to which nothing is taken away: thin sheets, as in the hand, would collapse."""

CREASE = np.cos(np.radians(40))
"""Faces that meet at more than this angle keep an edge between them."""

WHITE = (0.93, 0.93, 0.92)


def main() -> None:
    """Write the asset."""
    arrays: dict[str, NDArray] = {}
    for name in MESHES:
        made = decimated(name, KEPT)
        assert made.colors is not None
        arrays[f"{name}.vertices"] = np.round(made.vertices / VERTEX_UNIT).astype(np.int16)
        arrays[f"{name}.normals"] = np.round(made.normals * 127).astype(np.int8)
        arrays[f"{name}.colors"] = np.round(made.colors * 255).astype(np.uint8)
        arrays[f"{name}.triangles"] = made.triangles.astype(np.uint16)
    np.savez_compressed(ASSET, **arrays)  # pyright: ignore[reportArgumentType]
    faces = sum(len(arrays[f"{name}.triangles"]) for name in MESHES)
    print(f"{ASSET.name}: {faces} triangles, {ASSET.stat().st_size / 1e3:.0f} kB")


def decimated(name: str, kept: float) -> Mesh:
    """A mesh of the Panda with the share `kept` of its triangles, and its materials' colours."""
    made = [(*_simplified(points, faces, kept), color) for points, faces, color in materials(name)]
    vertices, normals, colors, triangles, first = [], [], [], [], 0
    for points, faces, color in made:
        v, n, f = with_normals(points, faces)
        vertices.append(v)
        normals.append(n)
        colors.append(np.tile(np.asarray(color, np.float32), (len(v), 1)))
        triangles.append(f + first)
        first += len(v)
    return Mesh(*map(np.concatenate, (vertices, normals, triangles, colors)))


def materials(name: str) -> list[tuple[NDArray, NDArray, tuple[float, ...]]]:
    """Welded points [V, 3], faces [F, 3] and display colour of each material of a mesh."""
    path = SOURCE / "visual" / f"{name}.obj"
    path = path if path.exists() else SOURCE / "collision" / f"{name}.obj"
    points, groups, color = [], {}, WHITE
    palette = _palette(path.with_suffix(".mtl")) if path.parent.name == "visual" else {}
    for line in path.read_text(errors="ignore").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            points.append([float(word) for word in words[:3]])
        elif kind == "usemtl":
            color = palette.get(words[0], WHITE)
        elif kind == "f":
            corners = [int(word.split("/")[0]) - 1 for word in words]
            fan = [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
            groups.setdefault(color, []).extend(fan)
    welded, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    found = []
    for color, fans in groups.items():
        used, faces = np.unique(index.ravel()[np.asarray(fans)], return_inverse=True)
        found.append((welded[used].astype(np.float32), faces.reshape(-1, 3), color))
    return found


def with_normals(points: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices, unit normals and triangles: smooth, with an edge at every crease.

    Each corner takes the mean over its vertex's faces, by area, of those that turn from its own
    face by less than the crease angle.
    """
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    area = np.cross(edges[:, 0], edges[:, 1])
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    around: list[list[int]] = [[] for _ in points]
    for number, face in enumerate(faces):
        for vertex in face:
            around[vertex].append(number)
    normals = np.empty((*faces.shape, 3))
    for number, face in enumerate(faces):
        for corner, vertex in enumerate(face):
            near = np.asarray(around[vertex])
            smooth = near[flat[near] @ flat[number] >= CREASE]
            normals[number, corner] = area[smooth].sum(0) if len(smooth) else flat[number]
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    rows = np.column_stack([faces.reshape(-1, 1), np.round(normals.reshape(-1, 3) * 127)])
    _, first, triangles = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = points[faces].reshape(-1, 3)
    return (
        corners[first].astype(np.float32),
        normals.reshape(-1, 3)[first].astype(np.float32),
        triangles.reshape(-1, 3).astype(np.int32),
    )


def _simplified(points: NDArray, faces: NDArray, kept: float) -> tuple[NDArray, NDArray]:
    if kept >= 1 or len(faces) < SMALL:
        return points, faces
    made = fast_simplification.simplify(points, faces.astype(np.int32), 1 - kept, agg=3)
    return made[0], made[1]


def _palette(path: Path) -> dict[str, tuple[float, ...]]:
    """Diffuse colours by material; pure colours are marks of the CAD model and become white."""
    palette, name = {}, ""
    for line in path.read_text(errors="ignore").splitlines():
        kind, *words = line.split() or [""]
        if kind == "newmtl":
            name = words[0]
        elif kind == "Kd":
            color = tuple(min(0.93, float(word)) for word in words[:3])
            palette[name] = WHITE if sorted(color) == [0, 0, 0.93] else color
    return palette


if __name__ == "__main__":
    main()
