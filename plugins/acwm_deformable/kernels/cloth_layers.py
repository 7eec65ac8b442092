"""Self-collision of cloth: Taichi functions that find nearby nodes and keep layers apart.

Nodes are balls with a radius of half a layer. Space is divided into cells that are hashed into
`BUCKETS` buckets and filled by a counting sort, so that the order of pairs is always the same:

    start  [BUCKETS + 1]  first entry of each bucket in `item`
    item   [N]            nodes, sorted by bucket
    pairs  [P, 2]         nodes that may touch before the next search; `count[0]` of them
"""

from acwm_deformable.kernels.cloth_solver import (
    LAYER,
    LAYER_FRICTION,
    Array,
    get3,
    set3,
    slowed,
)
from acwm_sim.engine import ti

BUCKETS = 4096

MARGIN = 1.8
"""Reach of the search in layers; nodes may approach by nearly a layer before the next search."""


@ti.func
def cell_of(x: Array, i, size):
    """Integer coordinates of the cell of a node."""
    return ti.floor(get3(x, i) / size, dtype=ti.i32)


@ti.func
def bucket_of(cell):
    """Bucket of a cell (the spatial hash of Teschner et al. 2003)."""
    mixed = (cell.x * 73856093) ^ (cell.y * 19349663) ^ (cell.z * 83492791)
    return mixed & (BUCKETS - 1)


@ti.func
def sort_nodes(x: Array, size, start: Array, item: Array):
    """Counting sort of the nodes into buckets."""
    for b in range(BUCKETS + 1):
        start[b] = 0
    for i in range(x.shape[0]):
        start[bucket_of(cell_of(x, i, size))] += 1
    for b in range(BUCKETS):
        start[b + 1] += start[b]
    for i in range(x.shape[0]):
        b = bucket_of(cell_of(x, i, size))
        start[b] -= 1
        item[start[b]] = i


@ti.func
def add_pairs(
    x: Array,
    i,
    bucket,
    below,
    columns,
    reach,
    start: Array,
    item: Array,
    pairs: Array,
    count: Array,
):
    """Add the pairs of node i with the nodes of a bucket; with `below`, only smaller numbers."""
    here = get3(x, i)
    for s in range(start[bucket], start[bucket + 1]):
        j = item[s]
        away = here - get3(x, j)
        if away.dot(away) < reach * reach and (j < i or (below == 0 and j > i)):
            # Neighbours on the sheet are recognised by their numbers; its edges keep them apart.
            step = ti.abs(i - j)
            near = step == 1 or ti.abs(step - columns) <= 1
            if not near and count[0] < pairs.shape[0]:
                pairs[count[0], 0], pairs[count[0], 1] = i, j
                count[0] += 1


@ti.func
def find_pairs(x: Array, columns, p: Array, start: Array, item: Array, pairs: Array, count: Array):
    """List all pairs of nodes that are less than `MARGIN` layers apart."""
    size = p[LAYER] * MARGIN
    sort_nodes(x, size, start, item)
    count[0] = 0
    for i in range(x.shape[0]):
        here = cell_of(x, i, size)
        for k in ti.static(range(13, 27)):  # a cell and half of its 26 neighbours: each pair once
            other = bucket_of(here + ti.math.ivec3(k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1))
            add_pairs(x, i, other, k == 13, columns, size, start, item, pairs, count)


@ti.func
def separate(x: Array, old: Array, w: Array, p: Array, pairs: Array, count: Array):
    """Push apart the listed nodes that are closer than a layer, with friction."""
    for q in range(count[0]):
        i, j = pairs[q, 0], pairs[q, 1]
        away = get3(x, i) - get3(x, j)
        far, total = away.norm(), w[i] + w[j]
        if far < p[LAYER] and total > 0:
            n, pen = away / (far + 1e-9), p[LAYER] - far
            slide = get3(x, i) - get3(old, i) - get3(x, j) + get3(old, j)
            slide -= n * n.dot(slide)
            step = n * pen - (slide - slowed(slide, p[LAYER_FRICTION] * pen))
            set3(x, i, get3(x, i) + step * (w[i] / total))
            set3(x, j, get3(x, j) - step * (w[j] / total))
