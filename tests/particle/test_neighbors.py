"""The neighbour search against SciPy's k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from acwm_particle.kernels.neighbors import find_neighbors, pack_grid, sort_into_cells
from acwm_sim import engine
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, I1, I2


@pytest.fixture(scope="module")
def search():
    engine.start()

    @ti.kernel
    def full(x: F2, grid: F1, start: I1, order: I1, reach: ti.f32, near: I2):
        ti.loop_config(serialize=True)
        for _ in range(1):
            sort_into_cells(x, x.shape[0], grid, start, order)
            find_neighbors(x, x.shape[0], grid, start, order, reach, False, near)

    @ti.kernel
    def half(x: F2, grid: F1, start: I1, order: I1, reach: ti.f32, near: I2):
        ti.loop_config(serialize=True)
        for _ in range(1):
            sort_into_cells(x, x.shape[0], grid, start, order)
            find_neighbors(x, x.shape[0], grid, start, order, reach, True, near)

    def run(points, reach, most=60, *, halved=False, low=(0, 0, 0), high=(1, 1, 1)):
        grid, cells = pack_grid(low, high, reach)
        start, order = np.zeros(cells + 1, np.int32), np.zeros(len(points), np.int32)
        near = np.zeros((len(points), most + 1), np.int32)
        (half if halved else full)(points, grid, start, order, reach, near)
        return [sorted(row[1 : 1 + row[0]].tolist()) for row in near], order

    return run


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(0, 1, (800, 3)).astype(np.float32)


def expected(points, reach):
    found = cKDTree(points.astype(float)).query_ball_point(points.astype(float), reach)
    return [sorted(set(row) - {i}) for i, row in enumerate(found)]


def test_finds_what_a_tree_finds(search, points):
    rows, order = search(points, 0.11)
    assert rows == expected(points, 0.11)
    assert sorted(order.tolist()) == list(range(len(points)))


def test_points_beyond_the_grid_are_found_too(search, points):
    far = (points * 3 - 1).astype(np.float32)
    assert search(far, 0.2)[0] == expected(far, 0.2)


def test_a_pair_stands_in_one_row_when_halved(search, points):
    rows, order = search(points, 0.11, halved=True)
    place = np.argsort(order)
    wanted = expected(points, 0.11)
    assert rows == [[j for j in row if place[j] < place[i]] for i, row in enumerate(wanted)]


def test_a_full_row_takes_no_more(search, points):
    rows, _ = search(points, 0.3, most=5)
    assert {len(row) for row in rows} == {5}
    assert all(set(row) <= set(full) for row, full in zip(rows, expected(points, 0.3), strict=True))
