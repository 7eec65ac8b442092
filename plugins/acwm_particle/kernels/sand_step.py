"""The single kernel that advances sand by a frame: position-based grains with friction and rest.

Contacts and friction follow Macklin et al. 2014 (Unified Particle Physics, sections 4 and 6.1),
solved pair by pair (Gauss–Seidel). Grains do not rotate, so the friction between them also
represents rolling resistance.

    x     [N, 3]  centres of the grains, metres
    last  [N, 3]  their positions at the beginning of the substep
    v     [N, 3]  velocities, m/s
    poses [S + 1, 12] the board's centre and rotation (row by row) before and after each substep
    held  [N]     zeros; within a substep 1 for a grain that touches another
    hit   [2]     set to 1 when a grain touches the board, and when a grain touches the ground
"""

from acwm_particle.kernels.neighbors import find_neighbors, sort_into_cells
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, I1, I2, Array, Vec3, get3, set3

Mat3 = ti.math.mat3

GRAVITY = 9.81
SEARCH_EVERY = 2
"""Number of substeps between two searches for neighbours."""

MARGIN = 1.3
"""Search distance for neighbours in diameters, enough for the movement in a substep."""

FASTEST = 0.8
"""Largest movement of a grain per substep in radii, so that no grain passes another."""

LIFT = 0.35
"""Extra share of a correction for the upper of two grains, so that heaps carry their weight after
few iterations (Macklin et al. 2014, section 5.4, scale masses by height for the same purpose)."""

REST = 0.015
"""Movement in radii per substep below which a grain in contact rests, so heaps do not creep."""

BOARD_FRICTION, GROUND_FRICTION = 0.25, 0.8


@ti.func
def rubbed(slip, pushed, friction, share):
    """The part of `slip` undone by friction in a contact that was `pushed` apart."""
    length, taken = slip.norm(), Vec3(0.0)
    if length > 1e-9:
        taken = slip * (share * ti.min(1.0, friction * pushed / length))
    return taken


@ti.func
def separate(x: Array, last: Array, near: Array, held: Array, i, radius, friction):
    """Push grain i and its neighbours apart, with friction."""
    for k in range(near[i, 0]):
        j = near[i, 1 + k]
        a, b = get3(x, i), get3(x, j)
        gap = a - b
        apart = gap.norm()
        if apart < 2 * radius and apart > 1e-9:
            n, deep = gap / apart, 2 * radius - apart
            share = 0.5 + LIFT * n.z
            a += n * (share * deep)
            b -= n * ((1 - share) * deep)
            held[i], held[j] = 1, 1
            slip = (a - get3(last, i)) - (b - get3(last, j))
            slip -= n * slip.dot(n)
            back = rubbed(slip, deep, friction, 0.5)
            set3(x, i, a - back)
            set3(x, j, b + back)


@ti.func
def board_at(poses: Array, s):
    """Centre and rotation of the board after s substeps."""
    center = Vec3(poses[s, 0], poses[s, 1], poses[s, 2])
    turn = Mat3(0.0)
    for k in ti.static(range(9)):
        turn[k // 3, k % 3] = poses[s, 3 + k]
    return center, turn


@ti.func
def off_faces(p, before, poses: Array, s, half, radius, hit: Array):
    """`off_board` for a grain near the board."""
    center, turn = board_at(poses, s + 1)
    local = turn.transpose() @ (p - center)
    inside = half + radius - ti.abs(local)
    if inside.min() > 0:
        hit[0] = 1
        n, deep = Vec3(0.0), 1e9
        for k in ti.static(range(3)):
            for sign in ti.static((-1, 1)):
                face = Vec3(turn[0, k], turn[1, k], turn[2, k]) * sign
                way = half[k] + radius - sign * local[k]
                if way < deep and p.z + face.z * way > 0.98 * radius:
                    n, deep = face, way
        if deep < 1e8:
            old_center, old_turn = board_at(poses, s)
            carried = center + turn @ local - (old_center + old_turn @ local)
            p += n * deep
            slip = p - before - carried
            slip -= n * slip.dot(n)
            p -= rubbed(slip, deep, BOARD_FRICTION, 1.0)
    return p


@ti.func
def off_board(p, before, poses: Array, s, half, radius, hit: Array):
    """A grain's centre, pushed out of the board through the nearest face with room behind it."""
    aside = p - Vec3(poses[s + 1, 0], poses[s + 1, 1], poses[s + 1, 2])
    if aside.dot(aside) < (half.norm() + radius) ** 2:  # most grains are far away
        p = off_faces(p, before, poses, s, half, radius, hit)
    return p


@ti.func
def off_ground(p, before, radius, hit: Array):
    """A grain's centre, pushed out of the ground."""
    deep = radius - p.z
    if deep > 0:
        hit[1] = 1
        p.z = radius
        slip = p - before
        slip.z = 0.0
        p -= rubbed(slip, deep, GROUND_FRICTION, 1.0)
    return p


@ti.func
def fall(x: Array, last: Array, v: Array, count, dt, radius, damping):
    """Apply gravity and move every grain as if nothing were in its way."""
    for i in range(count):
        speed = get3(v, i)
        speed.z -= GRAVITY * dt
        speed *= 1 - damping * dt
        limit = FASTEST * radius / dt
        if speed.norm() > limit:
            speed *= limit / speed.norm()
        set3(last, i, get3(x, i))
        set3(x, i, get3(x, i) + speed * dt)


@ti.func
def settle(x: Array, last: Array, v: Array, held: Array, count, dt, radius):
    """Compute new velocities; a grain in contact that hardly moved stays where it was."""
    for i in range(count):
        moved = get3(x, i) - get3(last, i)
        if held[i] == 1 and moved.norm() < REST * radius:
            moved = Vec3(0.0)
            set3(x, i, get3(last, i))
        set3(v, i, moved / dt)
        held[i] = 0


@ti.kernel
def sand_step(
    x: F2,
    last: F2,
    v: F2,
    poses: F2,
    half: ti.math.vec3,
    grid: F1,
    start: I1,
    order: I1,
    near: I2,
    held: I1,
    hit: I1,
    seconds: ti.f32,
    iterations: ti.i32,
    radius: ti.f32,
    friction: ti.f32,
    damping: ti.f32,
):
    """Advance all grains by `seconds` in as many substeps as `poses` has."""
    count, substeps = x.shape[0], poses.shape[0] - 1
    dt = seconds / substeps
    ti.loop_config(serialize=True)
    for s in range(substeps):
        fall(x, last, v, count, dt, radius, damping)
        if s % SEARCH_EVERY == 0:
            sort_into_cells(x, count, grid, start, order)
            find_neighbors(x, count, grid, start, order, 2 * radius * MARGIN, True, near)
        for it in range(iterations):
            for k in range(count):
                i = order[k]  # by cells: grains near in space are near in memory
                # Friction only in the first pass: later it would hold grains that still overlap.
                separate(x, last, near, held, i, radius, ti.select(it == 0, friction, 0.0))
                before = get3(last, i)
                p = off_board(get3(x, i), before, poses, s, half, radius, hit)
                set3(x, i, off_ground(p, before, radius, hit))
        for i in range(count):  # grains that the last pairs pushed into the board or the ground
            before = get3(last, i)
            p = off_ground(get3(x, i), before, radius, hit)
            set3(x, i, off_board(p, before, poses, s, half, radius, hit))
        settle(x, last, v, held, count, dt, radius)
