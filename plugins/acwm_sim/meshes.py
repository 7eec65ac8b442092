"""Triangle meshes: a container, and builders for common solids, centred on the origin."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in its own frame, in metres.

    Attributes:
        vertices: float32 [V, 3].
        normals: float32 [V, 3], unit length; interpolated over each triangle.
        triangles: int32 [F, 3]; counter-clockwise seen from outside.
        colors: float32 [V, 3] display colours; None if the scene gives one colour for all.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colors: NDArray[np.float32] | None = None

    def moved(self, offset: ArrayLike) -> "Mesh":
        """The same mesh, shifted by `offset` ([3], metres)."""
        vertices = (self.vertices + np.asarray(offset, np.float32)).astype(np.float32)
        return Mesh(vertices, self.normals, self.triangles, self.colors)

    def painted(self, color: ArrayLike) -> "Mesh":
        """The same mesh in one display colour ([3], 0 to 1)."""
        colors = np.tile(np.asarray(color, np.float32), (len(self.vertices), 1))
        return Mesh(self.vertices, self.normals, self.triangles, colors)


def mesh(vertices: ArrayLike, normals: ArrayLike, triangles: ArrayLike) -> Mesh:
    """A mesh from array-likes; triangles are reordered to match the direction of the normals."""
    v = np.asarray(vertices, np.float32).reshape(-1, 3)
    n = np.asarray(normals, np.float32).reshape(-1, 3)
    f = np.asarray(triangles, np.int32).reshape(-1, 3)
    facing = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    wrong = (facing * n[f].mean(axis=1)).sum(axis=1) < 0
    return Mesh(v, n, np.where(wrong[:, None], f[:, ::-1], f).astype(np.int32))


def join(*meshes: Mesh) -> Mesh:
    """Join several meshes into one; their colours are kept only if every mesh has colours."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    colors = [m.colors for m in meshes if m.colors is not None]
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.triangles + s for m, s in zip(meshes, starts, strict=True)]).astype(
            np.int32
        ),
        np.concatenate(colors) if len(colors) == len(meshes) else None,
    )


def box(half: ArrayLike, bevel: float = 0.0) -> Mesh:
    """A box of half sizes `half` (number or [3], metres).

    A `bevel` (metres) cuts the edges and shades them round, so that they catch light like real
    edges.
    """
    h = np.broadcast_to(np.asarray(half, np.float64), (3,))
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    vertices, normals, index = [], [], {}
    for axis in range(3):
        for corner in corners:
            index[axis, corner] = len(vertices)
            inset = np.where(np.arange(3) == axis, h, h - bevel)
            vertices.append(np.asarray(corner) * inset)
            normals.append(np.eye(3)[axis] * corner[axis])
    triangles = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            face = [k for k in corners if k[axis] == side]
            face.sort(key=lambda k, b=b, c=c: np.arctan2(k[c], k[b]))
            q = [index[axis, k] for k in face]
            triangles += [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
        for k in corners:
            if bevel and k[c] == -1:  # the edge along c between the faces of `axis` and of b
                far = tuple(1 if i == c else s for i, s in enumerate(k))
                q = [index[axis, k], index[axis, far], index[b, far], index[b, k]]
                triangles += [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
    if bevel:
        triangles += [[index[axis, k] for axis in range(3)] for k in corners]
    return mesh(vertices, normals, triangles)


def lathe(profile: ArrayLike, normals: ArrayLike, segments: int = 32) -> Mesh:
    """A surface of revolution around z.

    Args:
        profile: [K, 2, 2], K bands; each has two points (radius, z) in metres.
        normals: [K, 2, 2], the normals (outward, along z) at these points.
        segments: number of sides around z.
    """
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    v, n, f = [], [], []
    ends = zip(np.asarray(profile, np.float64), np.asarray(normals, np.float64), strict=True)
    for band, (points, directions) in enumerate(ends):
        for point, direction in zip(points, directions, strict=True):
            v.append(np.column_stack([around * point[0], np.full(segments, point[1])]))
            n.append(np.column_stack([around * direction[0], np.full(segments, direction[1])]))
        i = np.arange(segments)
        j, low, high = (i + 1) % segments, band * 2 * segments, (band * 2 + 1) * segments
        f.append(np.column_stack([low + i, low + j, high + j]))
        f.append(np.column_stack([low + i, high + j, high + i]))
    built = mesh(np.concatenate(v), np.concatenate(n), np.concatenate(f))
    corners = built.vertices[built.triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return Mesh(built.vertices, built.normals, built.triangles[area > 1e-12])


def cylinder(radius: float, half: float, bevel: float = 0.0, segments: int = 32) -> Mesh:
    """A cylinder along z with both caps, of half height `half`; sizes in metres."""
    r, b = radius, bevel
    bands = [
        ([(0, -half), (r - b, -half)], [(0, -1), (0, -1)]),
        ([(r, -half + b), (r, half - b)], [(1, 0), (1, 0)]),
        ([(r - b, half), (0, half)], [(0, 1), (0, 1)]),
    ]
    if bevel:
        bands.append(([(r - b, -half), (r, -half + b)], [(0, -1), (1, 0)]))
        bands.append(([(r, half - b), (r - b, half)], [(1, 0), (0, 1)]))
    profile, normals = zip(*bands, strict=True)
    return lathe(profile, normals, segments)


def capsule(radius: float, half: float, segments: int = 24, rings: int = 6) -> Mesh:
    """A cylinder along z of half height `half` between two half spheres; sizes in metres."""
    angle = np.linspace(0, np.pi / 2, rings + 1)
    cap = np.column_stack([np.cos(angle), np.sin(angle)])
    bands = [([(radius, -half), (radius, half)], [(1, 0), (1, 0)])]
    for low, high in itertools.pairwise(cap):
        for sign in (-1, 1):
            flip = np.array([1, sign])
            ends = [flip * (radius * p) + (0, sign * half) for p in (low, high)]
            bands.append((ends, [flip * low, flip * high]))
    profile, normals = zip(*bands, strict=True)
    return lathe(profile, normals, segments)


def tube(points: ArrayLike, radius: float, segments: int = 8) -> Mesh:
    """A thick line: a tube along `points` [N, 3], N ≥ 2, closed at both ends.

    `radius` is in metres. A line must be at least half a pixel wide to appear unbroken. The tube
    gets thinner at corners, so give a bend several points.
    """
    p = np.asarray(points, np.float64)
    ahead = np.diff(p, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    tangents = np.vstack([ahead[:1], ahead[1:] + ahead[:-1], ahead[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    rings: list[NDArray[np.float64]] = []
    for tangent in tangents:  # carry the frame along, so that the tube does not twist
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        rings.append(np.cos(turn) * side + np.sin(turn) * np.cross(tangent, side))
    normals = np.concatenate(rings)
    vertices = np.repeat(p, segments, axis=0) + radius * normals
    k, count = np.arange(segments), len(p)
    quads = [(a * segments + k, a * segments + (k + 1) % segments) for a in range(count - 1)]
    f = [
        np.column_stack(t)
        for a, b in quads
        for t in ((a, b, b + segments), (a, b + segments, a + segments))
    ]
    caps = [(0, -tangents[0]), ((count - 1) * segments, tangents[-1])]
    for number, (first, normal) in enumerate(caps):
        start = count * segments + number * segments
        vertices = np.vstack([vertices, vertices[first : first + segments]])
        normals = np.vstack([normals, np.tile(normal, (segments, 1))])
        f.append(np.column_stack([np.full(segments - 2, start), start + k[1:-1], start + k[2:]]))
    return mesh(vertices, normals, np.concatenate(f))


def plane(half: ArrayLike, tiles: int = 1, colors: ArrayLike | None = None) -> Mesh:
    """A rectangle at z = 0 facing up, divided into `tiles` × `tiles`.

    Args:
        half: half sizes in metres, a number or [2].
        tiles: number of tiles along each side.
        colors: two display colours [2, 3] for a checkerboard, or None.
    """
    size = np.broadcast_to(np.asarray(half, np.float64), (2,))
    v, f, c = [], [], []
    for i in range(tiles):
        for j in range(tiles):
            f += [[len(v), len(v) + 1, len(v) + 2], [len(v), len(v) + 2, len(v) + 3]]
            for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
                v.append([size[0] * (2 * a / tiles - 1), size[1] * (2 * b / tiles - 1), 0])
                c.append((i + j) % 2)
    built = mesh(v, np.tile([0.0, 0.0, 1.0], (len(v), 1)), f)
    if colors is None:
        return built
    tiled = np.asarray(colors, np.float32)[np.asarray(c)]
    return Mesh(built.vertices, built.normals, built.triangles, tiled)


def frame_of_boxes(inner: float, thick: float, height: float, round_by: float) -> Mesh:
    """Four walls around a square floor of half width `inner`; `thick` is half their thickness."""
    side, out, half = inner + 2 * thick, inner + thick, height / 2
    spans = ((out, 0, thick, side), (-out, 0, thick, side))
    spans += ((0, out, side, thick), (0, -out, side, thick))
    return join(*(box((a, b, half), round_by).moved((x, y, half)) for x, y, a, b in spans))
