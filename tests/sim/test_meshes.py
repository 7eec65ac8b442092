"""Meshes are closed, turned outwards, and of the right volume."""

import numpy as np
import pytest

from acwm_sim.meshes import box, capsule, cylinder, join, plane, tube

TURN = 32 * np.sin(2 * np.pi / 32) / 2  # area of a regular 32-gon of radius 1
ARC = np.linspace(0, np.pi, 60)


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(float) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box((1, 2, 3)), 48),
        (box(0.5), 1),
        (cylinder(1, 2), 4 * TURN),
        (capsule(1, 1, segments=64, rings=24), (2 + 4 / 3) * np.pi),
        (tube([(0, 0, 0), (1, 2, 2)], 0.5, segments=32), 3 * 0.25 * TURN),
        (tube(np.column_stack([np.cos(ARC), np.sin(ARC), 0 * ARC]), 0.1, 32), np.pi * 0.01 * TURN),
        (join(box(0.5), box(0.5).moved((3, 0, 0))), 2),
    ],
)
def test_volume(mesh, expected):
    assert volume(mesh) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("bevel", [0.02, 0.1])
def test_bevelled_box_is_closed_and_a_little_smaller(bevel):
    # Each of twelve edges loses a triangular prism, each of eight corners 5/6 of a small cube.
    lost = 12 * bevel**2 / 2 * (1 - 2 * bevel) + 8 * 5 / 6 * bevel**3
    assert volume(box(0.5, bevel)) == pytest.approx(1 - lost, rel=1e-5)
    assert 0 < volume(cylinder(1, 1)) - volume(cylinder(1, 1, bevel)) < 4 * np.pi * bevel**2


@pytest.mark.parametrize(
    "mesh", [box(1, 0.1), cylinder(1, 1, 0.1), capsule(1, 1), plane(1, 3), tube(np.eye(3), 0.1)]
)
def test_normals_are_unit_and_agree_with_the_faces(mesh):
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    v = mesh.vertices[mesh.triangles]
    facing = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    assert (np.einsum("ij,ij->i", facing, mesh.normals[mesh.triangles].mean(1)) > 0).all()


def test_checkerboard():
    board = plane(1.0, 4, [(1, 1, 1), (0, 0, 0)])
    assert board.colors is not None
    assert len(board.triangles) == 32
    assert board.colors.mean() == 0.5
