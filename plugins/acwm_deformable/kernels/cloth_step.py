"""The single kernel that advances cloth and grippers by a frame; each launch costs about 50 µs.

Arrays are those of `cloth_solver` and `cloth_layers`, and

    held    [K]     node that a gripper holds, or -1
    hand    [K, 3]  positions of the grippers, metres
    offset  [K, 3]  from a gripper to the node that it holds; it shrinks as the jaws pull it in
    step    [K, 3]  how far the grippers should move in this frame
    wish    [K, 3]  scratch space
    touched [2 + K] set to 1 when the cloth touches sphere or ground, or gripper k the sphere
    strain  [1]     strain of the most stretched edge afterwards
"""

from acwm_deformable.kernels.cloth_layers import find_pairs, separate
from acwm_deformable.kernels.cloth_solver import (
    BEND,
    BOX,
    HAND,
    SPACING,
    SPHERE,
    WIDE,
    Array,
    Vec3,
    bend,
    collide,
    get3,
    longest_edge,
    outside,
    predict,
    reach_limits,
    set3,
    shear,
    stretch,
    tether,
    tidy,
    update_velocity,
)
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, I1, I2

SEARCH_EVERY = 6
"""Number of substeps between two searches for nodes that may touch."""

SLACK = 0.035
"""Strain of the thread between two grippers at which they stop."""

DRAW_IN = 0.85
"""Factor per substep on the distance between a gripper and the node that it holds."""


@ti.func
def shift(wish: Array, k, move, together):
    """Move gripper k, or all grippers if they form one body."""
    for j in range(wish.shape[0]):
        if j == k or together == 1:
            set3(wish, j, get3(wish, j) + move)


@ti.func
def keep_in_room(wish: Array, together, p: Array, touched: Array):
    """Keep grippers in their box and outside the sphere; they slide along both."""
    center = Vec3(p[SPHERE], p[SPHERE + 1], p[SPHERE + 2])
    for k in range(wish.shape[0]):
        for a in ti.static(range(3)):
            at, move = wish[k, a], Vec3(0.0)
            move[a] = ti.math.clamp(at, p[BOX + 2 * a], p[BOX + 2 * a + 1]) - at
            shift(wish, k, move, together)
        away = get3(wish, k) - center
        pen = p[SPHERE + 3] + p[HAND] - away.norm()
        if pen > 0:
            shift(wish, k, away.normalized() * pen, together)
            touched[2 + k] = 1


@ti.func
def node_between(first, last, share, columns):
    """The node nearest to a point on the straight line between two nodes of the flat cloth."""
    row = (first // columns) * (1 - share) + (last // columns) * share
    column = (first % columns) * (1 - share) + (last % columns) * share
    return int(ti.round(row)) * columns + int(ti.round(column))


@ti.func
def thread(x: Array, first, last, columns):
    """Follow the thread of the weave that runs straight from one node to another.

    Returns:
        Its current length in metres, its rest length in edges, and unit vectors along it at both
        ends, pointing inwards.
    """
    down, across = last // columns - first // columns, last % columns - first % columns
    count, at = ti.max(ti.abs(down), ti.abs(across)), first
    length, ahead, back = 0.0, Vec3(0.0), Vec3(0.0)
    for q in range(1, count + 1):
        to = node_between(first, last, q / float(count), columns)
        away = get3(x, to) - get3(x, at)
        length += away.norm()
        if q == 1:
            ahead = away.normalized(1e-9)
        back, at = -away.normalized(1e-9), to
    return length, ti.sqrt(float(down * down + across * across)), ahead, back


@ti.func
def yield_to_cloth(
    x: Array, held: Array, step: Array, wish: Array, columns, share, together, p: Array
):
    """Move two grippers back if the thread between them is taut.

    The thread may be straight or lie around the sphere. Cloth does not stretch, so the arms have to
    stop.
    """
    for j in range(held.shape[0]):
        for k in range(j):
            if held[j] >= 0 and held[k] >= 0:
                length, rest, ahead, back = thread(x, held[j], held[k], columns)
                excess = length - rest * p[SPACING] * (1 + SLACK)
                if excess > 0:
                    first, second = get3(step, j).norm() * share, get3(step, k).norm() * share
                    if together == 1:
                        inwards = ahead + back
                        size = inwards.norm() + 1e-3
                        shift(wish, j, inwards * (ti.min(excess / size, first) / size), 1)
                    else:
                        shift(wish, j, ahead * ti.min(excess, first), 0)
                        shift(wish, k, back * ti.min(excess, second), 0)


@ti.func
def move_hands(
    x: Array,
    held: Array,
    hand: Array,
    offset: Array,
    step: Array,
    wish: Array,
    columns,
    share,
    together,
    p: Array,
    touched: Array,
):
    """Move the grippers by a share of the frame's step, as far as room and cloth allow."""
    for k in range(hand.shape[0]):
        set3(wish, k, get3(hand, k) + get3(step, k) * share)
    yield_to_cloth(x, held, step, wish, columns, share, together, p)
    keep_in_room(wish, together, p, touched)
    for k in range(hand.shape[0]):
        set3(hand, k, get3(wish, k))
        set3(offset, k, get3(offset, k) * DRAW_IN)
        if held[k] >= 0:
            node, _in_sphere, _in_ground = outside(get3(hand, k) + get3(offset, k), p)
            set3(x, held[k], node)


@ti.kernel
def advance_cloth(
    x: F2,
    old: F2,
    v: F2,
    w: F1,
    p: F1,
    held: I1,
    hand: F2,
    offset: F2,
    step: F2,
    wish: F2,
    start: I1,
    item: I1,
    pairs: I2,
    count: I1,
    touched: I1,
    strain: F1,
    columns: ti.i32,
    substeps: ti.i32,
    together: ti.i32,
):
    """Simulate `substeps` substeps; with `together`, what stops one gripper stops all."""
    rows = x.shape[0] // columns
    ti.loop_config(serialize=True)
    for s in range(substeps):
        if s % SEARCH_EVERY == 0:
            find_pairs(x, columns, p, start, item, pairs, count)
        predict(x, old, v, w, p)
        move_hands(x, held, hand, offset, step, wish, columns, 1.0 / substeps, together, p, touched)
        collide(x, old, w, p, touched)
        bend(x, w, 1, rows, columns, p[BEND])
        if p[WIDE] >= 0:
            bend(x, w, 2, rows, columns, p[WIDE])
        shear(x, w, rows, columns, p)
        for span in ti.static((8, 3)):
            tether(x, w, span, rows, columns, p)
        stretch(x, w, rows, columns, p, s % 2)
        reach_limits(x, w, held, columns, p)
        separate(x, old, w, p, pairs, count)
        collide(x, old, w, p, touched)
        update_velocity(x, old, v, p)
        if s == substeps - 1:
            tidy(x, w, rows, columns, p)
            strain[0] = longest_edge(x, rows, columns, p)
