"""Sort particles in memory by the cells of a grid, and list their neighbours.

Water is swept from the bottom up, many times per search. So particles are stored in that order (by
layers of cells, then rows), and neighbours are listed in both directions. Taichi functions for use
inside a kernel; serial, so that equal inputs give equal lists.

    x, v    [N, 3]  positions and velocities; `number` [N] int32 says which particle is in a row
    kept    [N, 7]  scratch
    start   [C + 1] int32; the particles of cell c are rows `start[c]` to `start[c + 1]`
    near    [N, K + 1] int32; column 0 is the number of neighbours of particle i, then their rows
"""

from acwm_particle.kernels.neighbors import cell_along
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, get3


@ti.func
def layered_cell(grid: Array, p):
    """Index of the cell that contains a point: along x, then y, then up."""
    layer = cell_along(grid, p.z, 2) * int(grid[5]) + cell_along(grid, p.y, 1)
    return layer * int(grid[4]) + cell_along(grid, p.x, 0)


@ti.func
def sort_particles(x: Array, v: Array, number: Array, kept: Array, grid: Array, start: Array):
    """Sort the particles by cell: a counting sort."""
    count, cells = x.shape[0], start.shape[0] - 1
    for c in range(cells + 1):
        start[c] = 0
    for i in range(count):
        start[layered_cell(grid, get3(x, i))] += 1
        for a in ti.static(range(3)):
            kept[i, a] = x[i, a]
            kept[i, 3 + a] = v[i, a]
        kept[i, 6] = ti.cast(number[i], ti.f32)
    total = 0
    for c in range(cells + 1):
        total += start[c]
        start[c] = total
    for k in range(count):
        i = count - 1 - k
        c = layered_cell(grid, ti.math.vec3(kept[i, 0], kept[i, 1], kept[i, 2]))
        start[c] -= 1
        row = start[c]
        for a in ti.static(range(3)):
            x[row, a] = kept[i, a]
            v[row, a] = kept[i, 3 + a]
        number[row] = ti.cast(kept[i, 6], ti.i32)


@ti.func
def list_neighbors(x: Array, grid: Array, start: Array, near: Array):
    """List all pairs of particles within a cell's side of each other; a full row takes no more."""
    count, most, reach = x.shape[0], near.shape[1] - 1, grid[3] * grid[3]
    for i in range(count):
        near[i, 0] = 0
    for i in range(count):
        p, found = get3(x, i), near[i, 0]
        a, b, c = cell_along(grid, p.x, 0), cell_along(grid, p.y, 1), cell_along(grid, p.z, 2)
        a0, a1 = ti.max(a - 1, 0), ti.min(a + 1, int(grid[4]) - 1)
        for u in range(ti.max(c - 1, 0), c + 1):
            for w in range(ti.max(b - 1, 0), ti.min(b + 2, int(grid[5]))):
                row = (u * int(grid[5]) + w) * int(grid[4])
                # Neighbouring cells along x are adjacent in memory.
                for j in range(start[row + a0], ti.min(start[row + a1 + 1], i)):
                    d = p - get3(x, j)
                    if d.dot(d) < reach and found < most and near[j, 0] < most:
                        found += 1
                        near[i, found] = j
                        near[j, 0] += 1
                        near[j, near[j, 0]] = i
        near[i, 0] = found


@ti.func
def sort_by_height(x: Array, number: Array, layer, row_of: Array, bins: Array, order: Array):
    """List rows in `order` from the lowest layer up; within a layer by number, which is random."""
    count, most = x.shape[0], bins.shape[0] - 2
    for b in range(most + 2):
        bins[b] = 0
    for i in range(count):
        row_of[number[i]] = i
        bins[ti.max(0, ti.min(int(x[i, 2] / layer), most))] += 1
    total = 0
    for b in range(most + 1):
        total += bins[b]
        bins[b] = total
    for k in range(count):
        i = row_of[count - 1 - k]
        b = ti.max(0, ti.min(int(x[i, 2] / layer), most))
        bins[b] -= 1
        order[bins[b]] = i
