"""Rebuild `panda.npz`, the low-polygon Franka Panda: `python -m acwm_sim.decimate_panda`.

Reads the visual meshes in the PyBullet wheel (Apache-2.0, `pybullet_data/franka_panda`),
simplifies each large material of each link by quadric edge collapse (Garland and Heckbert 1997,
from the package fast-simplification), shades it with the normals of the full mesh and writes
vertices in hundredths of a millimetre, normals in bytes.
"""

from pathlib import Path

import fast_simplification
import numpy as np
import pybullet_data
from numpy.typing import NDArray

from acwm_sim.meshes import Mesh
from acwm_sim.panda import ASSET, MESHES, VERTEX_UNIT

SOURCE = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes"

KEPT = 0.3
"""Share of the triangles to keep in large materials. A 240×240 frame of the arm then has a PSNR
above 50 dB against one of the full meshes (`tests/sim/test_panda.py`)."""

SMALL = 4000
"""Materials with fewer triangles are not simplified: thin sheets, as in the hand, would collapse,
and printed signs would sink into the surface below them."""

AGG = 3
"""Aggressiveness of fast-simplification, from 0 to 10."""

REACH = 0.01
"""Distance in metres that counts as much as an angle of one radian when looking up a normal."""

CREASE = np.cos(np.radians(40))
"""Cosine of the crease angle: faces that meet at a larger angle keep a sharp edge."""

WHITE = (0.93, 0.93, 0.92)


def main() -> None:
    """Write the asset `panda.npz`."""
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
    """A mesh of the Panda with a share `kept` of its triangles, in its materials' colours."""
    vertices, normals, colors, triangles, first = [], [], [], [], 0
    for points, faces, color in materials(name):
        v, n, f = with_normals(points, faces)
        if kept < 1 and len(faces) >= SMALL:
            made = fast_simplification.simplify(points, faces.astype(np.int32), 1 - kept, agg=AGG)
            v, n, f = borrowed_normals(made[0], made[1], v, n)
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
    points, groups, material = [], {}, ""
    palette = _palette(path.with_suffix(".mtl")) if path.parent.name == "visual" else {}
    for line in path.read_text("utf-8", errors="ignore").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            points.append([float(word) for word in words[:3]])
        elif kind == "usemtl":
            material = words[0]
        elif kind == "f":
            corners = [int(word.split("/")[0]) - 1 for word in words]
            fan = [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
            groups.setdefault(material, []).extend(fan)
    welded, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    found = []
    for material, fans in groups.items():
        used, faces = np.unique(index.ravel()[np.asarray(fans)], return_inverse=True)
        color = palette.get(material, WHITE)
        found.append((welded[used].astype(np.float32), faces.reshape(-1, 3), color))
    return found


def with_normals(points: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices, unit normals and triangles for smooth shading with sharp edges at creases.

    The normal of a corner is the area-weighted mean over those faces at its vertex whose angle to
    the corner's own face is below the crease angle.
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
    return _joined(points, faces, normals)


def borrowed_normals(
    points: NDArray, faces: NDArray, near: NDArray, normals: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices, unit normals and triangles, shaded like the mesh that `points` came from.

    Each corner takes the normal of the closest vertex of that mesh (`near` [V, 3], `normals`
    [V, 3]). Closeness counts position and, for the two sides of a crease, the angle between the
    vertex normal and the corner's own face.
    """
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    area = np.cross(edges[:, 0], edges[:, 1])
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    corners = np.hstack([points[faces].reshape(-1, 3), REACH * np.repeat(flat, 3, axis=0)])
    known = np.hstack([near, REACH * normals])
    lengths = (known**2).sum(1)
    closest = [
        np.argmin(lengths - 2 * part @ known.T, axis=1)
        for part in np.array_split(corners, len(corners) // 500 + 1)
    ]
    return _joined(points, faces, normals[np.concatenate(closest)].reshape(-1, 3, 3))


def _joined(points: NDArray, faces: NDArray, normals: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Merge all corners [F, 3] that share a point and a normal [F, 3, 3] into one vertex."""
    rows = np.column_stack([faces.reshape(-1, 1), np.round(normals.reshape(-1, 3) * 127)])
    _, first, triangles = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = points[faces].reshape(-1, 3)
    return (
        corners[first].astype(np.float32),
        normals.reshape(-1, 3)[first].astype(np.float32),
        triangles.reshape(-1, 3).astype(np.int32),
    )


def _palette(path: Path) -> dict[str, tuple[float, ...]]:
    """Diffuse colours by material; pure primary colours mark parts in the CAD model: use white."""
    palette, name = {}, ""
    for line in path.read_text("utf-8", errors="ignore").splitlines():
        kind, *words = line.split() or [""]
        if kind == "newmtl":
            name = words[0]
        elif kind == "Kd":
            color = tuple(min(0.93, float(word)) for word in words[:3])
            palette[name] = WHITE if sorted(color) == [0, 0, 0.93] else color
    return palette


if __name__ == "__main__":
    main()
