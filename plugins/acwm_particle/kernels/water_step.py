"""The single kernel that advances water by a frame: position-based fluids (Macklin & Müller 2013).

The density constraint (equation 1 there; poly6 densities, spiky gradients) is solved particle by
particle (Gauss-Seidel), from the bottom up. So the lower water is correct before it has to carry
the upper, and one sweep per short substep is enough (Macklin et al. 2019, Small Steps). Walls are
not sampled by particles: a wall adds the density that a half space full of water would add
(vessels.py), and keeps the centres of particles a radius away.

    x      [N, 3]  centres of the particles, metres
    last   [N, 3]  their positions at the beginning of the substep
    v      [N, 3]  velocities, m/s
    number [N]     which particle is in this row, as rows are sorted repeatedly
    near   [N, K + 1] neighbours (water_cells.py)
    order  [N]     rows from the lowest up
    density [N]    relative to rest, from the last sweep
    hit    [V + 1] set to 1 when a particle touches vessel k, and (last) when one touches the table
"""

from acwm_particle.kernels.vessels import fullness, push_off_walls
from acwm_particle.kernels.water_cells import list_neighbors, sort_by_height, sort_particles
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, F3, I1, I2, Array, Vec3, get3, set3

GRAVITY = 9.81
MAX_KICK = 2.0
"""Largest change of a velocity by constraints in a substep, m/s. Water that is stopped suddenly is
compressed for a substep. If it were pushed apart again at once, it would fly out of the cup with
more energy than before. Physics engines limit the depenetration velocity for the same reason."""
SPIKY = 64 / 7
"""Ratio of the spiky kernel's slope factor to the poly6 kernel's value at its centre: 45/π over
315/(64 π), with the kernel radius as the unit of length."""


@ti.func
def fall(x: Array, last: Array, v: Array, dt):
    """Apply gravity and move every particle as if nothing were in its way (Algorithm 1)."""
    for i in range(x.shape[0]):
        speed = get3(v, i)
        speed.z -= GRAVITY * dt
        set3(last, i, get3(x, i))
        set3(x, i, get3(x, i) + speed * dt)


@ti.func
def limit_kick(before, after, dt):
    """The velocity after a substep, changed by at most `MAX_KICK`."""
    before.z -= GRAVITY * dt
    kick = after - before
    size = ti.sqrt(kick.dot(kick))
    if size > MAX_KICK:
        after = before + kick * (MAX_KICK / size)
    return after


@ti.func
def slope(d, h, scale):
    """The spiky kernel's slope divided by the distance, for an offset d; zero out of reach."""
    far = ti.sqrt(d.dot(d)) + 1e-9
    gap = ti.max(1 - far / h, 0.0)
    return scale * gap * gap / (h * far)


@ti.func
def make_room(x: Array, near: Array, i, h, alone, share, gradient):
    """Solve the density constraint of particle i (equations 1, 8, 9, 11): move it and others.

    Args:
        alone: density of a single particle, relative to rest.
        share, gradient: density and gradient added by walls.

    Returns:
        The density before.
    """
    p, density, squares = get3(x, i), alone + share, 0.0
    for k in range(near[i, 0]):
        d = p - get3(x, near[i, 1 + k])
        w = ti.max(1 - d.dot(d) / (h * h), 0.0)
        density += alone * w * w * w
        toward = d * slope(d, h, alone * SPIKY)
        gradient -= toward
        squares += toward.dot(toward)
    if density > 1:
        push = (density - 1) / (squares + gradient.dot(gradient))
        for k in range(near[i, 0]):
            j = near[i, 1 + k]
            d = p - get3(x, j)
            steep = slope(d, h, alone * SPIKY)
            if steep > 0:
                set3(x, j, get3(x, j) - d * (push * steep))
        set3(x, i, p - gradient * push)
    return density


@ti.func
def blend(x: Array, v: Array, mix: Array, near: Array, h, alone, viscosity):
    """Make every velocity a little more like its neighbours' (XSPH, equation 17)."""
    for i in range(x.shape[0]):
        p, speed, total = get3(x, i), get3(v, i), Vec3(0.0)
        for k in range(near[i, 0]):
            j = near[i, 1 + k]
            d = p - get3(x, j)
            w = ti.max(1 - d.dot(d) / (h * h), 0.0)
            total += (get3(v, j) - speed) * (alone * w * w * w)
        set3(mix, i, speed + total * viscosity)
    for i in range(x.shape[0]):
        set3(v, i, get3(mix, i))


@ti.kernel
def water_step(
    x: F2,
    last: F2,
    v: F2,
    mix: F2,
    number: I1,
    density: F1,
    near: I2,
    grid: F1,
    start: I1,
    row_of: I1,
    bins: I1,
    order: I1,
    path: F3,
    sizes: F2,
    hit: I1,
    seconds: ti.f32,
    per_search: ti.i32,
    radius: ti.f32,
    h: ti.f32,
    alone: ti.f32,
    viscosity: ti.f32,
):
    """Advance all water by `seconds` in as many substeps as `path` has.

    In every `per_search`-th substep, neighbours are searched and velocities blended.
    """
    count, substeps = x.shape[0], path.shape[0] - 1
    dt = seconds / substeps
    ti.loop_config(serialize=True)
    for s in range(substeps):
        if s % per_search == 0:
            sort_particles(x, v, number, mix, grid, start)
            list_neighbors(x, grid, start, near)
            sort_by_height(x, number, radius, row_of, bins, order)
            blend(x, v, mix, near, h, alone, viscosity)
        fall(x, last, v, dt)
        for k in range(count):
            i = order[k]
            push_off_walls(x, last, path, sizes, s, i, radius, hit)
            share, gradient = fullness(get3(x, i), path, sizes, s, h)
            density[i] = make_room(x, near, i, h, alone, share, gradient)
        for i in range(count):
            push_off_walls(x, last, path, sizes, s, i, radius, hit)
            set3(v, i, limit_kick(get3(v, i), (get3(x, i) - get3(last, i)) / dt, dt))
