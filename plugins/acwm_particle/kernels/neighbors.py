"""Neighbour search for particles: a counting sort into the cells of a uniform grid.

Taichi functions for use inside a kernel; serial, so that equal inputs give equal lists.

    x       [N, 3]  positions, metres
    start   [C + 1] int32; the particles of cell c are `order[start[c] : start[c + 1]]`
    order   [N]     int32; particles by cell
    near    [N, K + 1] int32; column 0 is the number of neighbours of particle i, then their indices

`grid` is an array that describes the cells; see `pack_grid`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, get3


def pack_grid(low: ArrayLike, high: ArrayLike, cell: float) -> tuple[NDArray[np.float32], int]:
    """The `grid` that covers a box with cubic cells, and the number C of cells.

    Args:
        low: [3] lowest corner in metres. Particles outside belong to the nearest cell.
        high: [3] highest corner in metres.
        cell: side of a cell in metres, at least the search distance for neighbours.
    """
    counts = np.ceil(np.subtract(high, low) / cell).astype(int)
    return np.array([*np.asarray(low), cell, *counts], np.float32), int(np.prod(counts))


@ti.func
def cell_along(grid: Array, value, axis: ti.template()):
    """Index of the cell along one axis, clamped to the grid."""
    place = int(ti.floor((value - grid[axis]) / grid[3]))
    return ti.max(0, ti.min(place, int(grid[4 + axis]) - 1))


@ti.func
def cell_of(grid: Array, p):
    """Index of the cell that contains a point."""
    row = cell_along(grid, p.x, 0) * int(grid[5]) + cell_along(grid, p.y, 1)
    return row * int(grid[6]) + cell_along(grid, p.z, 2)


@ti.func
def sort_into_cells(x: Array, count, grid: Array, start: Array, order: Array):
    """Fill `start` and `order` for the first `count` particles: a counting sort by cell."""
    cells = start.shape[0] - 1
    for c in range(cells + 1):
        start[c] = 0
    for i in range(count):
        start[cell_of(grid, get3(x, i))] += 1
    total = 0
    for c in range(cells + 1):
        total += start[c]
        start[c] = total
    for k in range(count):
        i = count - 1 - k
        c = cell_of(grid, get3(x, i))
        start[c] -= 1
        order[start[c]] = i


@ti.func
def find_neighbors(
    x: Array,
    count,
    grid: Array,
    start: Array,
    order: Array,
    reach,
    half: ti.template(),
    near: Array,
):
    """Fill `near` with the particles within `reach`; a full row takes no more.

    With `half`, each pair is listed only once, in the row of the particle later in `order`.
    """
    most, rows, across, deep = near.shape[1] - 1, int(grid[4]), int(grid[5]), int(grid[6])
    square = reach * reach
    for at in range(count):
        i = order[at]
        p, found = get3(x, i), 0
        a, b, c = cell_along(grid, p.x, 0), cell_along(grid, p.y, 1), cell_along(grid, p.z, 2)
        c0, c1 = ti.max(c - 1, 0), ti.min(c + 1, deep - 1)
        own = a * across + b
        for u in range(ti.max(a - 1, 0), ti.min(a + 2, rows)):
            for w in range(ti.max(b - 1, 0), ti.min(b + 2, across)):
                row = u * across + w
                if not ti.static(half) or row <= own:
                    # Neighbouring cells along z are adjacent in `order`.
                    stop = start[row * deep + c1 + 1]
                    if ti.static(half):
                        stop = ti.min(stop, at)
                    for k in range(start[row * deep + c0], stop):
                        j = order[k]
                        d = p - get3(x, j)
                        if j != i and found < most and d.dot(d) < square:
                            near[i, 1 + found] = j
                            found += 1
        near[i, 0] = found
