"""Screen-space fluid: particles are splatted and their depth is smoothed to a surface.

After van der Laan, Green and Sainz, "Screen space fluid rendering with curvature flow" (2009),
with a bilateral filter instead of the flow. The surface is smooth and thins out at its rim, so it
needs fewer samples than opaque parts: one cell is `cell` samples wide. Arrays, for R rows and C
columns of cells:

    pool  [4, R, C]  depth of the fluid's front in metres, FAR where there is none; thickness of the
                     fluid behind it in metres; two layers of scratch space
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec3
from acwm_sim.kernels.raster import FAR, outline, row3, span, to_camera
from acwm_sim.kernels.tiles import ray_through
from acwm_sim.parts import BALL_0, BALL_1, FLUID, KIND, VISIBLE

TAPS = 4
"""Number of positions that smoothing reads on each side."""

WIDTHS = (1.8, 1.2, 0.6)
"""Half widths of the smoothing rounds, in drawn particle radii."""


@ti.func
def farthest(depth: Array, cell, y, x):
    """The largest depth of the samples in a cell."""
    deep = 0.0
    for s in range(cell * cell):
        deep = ti.max(deep, depth[0, y * cell + s // cell, x * cell + s % cell])
    return deep


@ti.func
def splat_drop(view: Array, balls: Array, s, cell, depth: Array, pool: Array):
    """Draw a particle: the nearest front wins, and the thicknesses add up."""
    center = Vec3(balls[s, 0], balls[s, 1], balls[s, 2]) - row3(view, at.EYE)
    c, r, f = to_camera(view, center), view[at.GRAIN], view[at.FOCAL] / cell
    if c.z > r + at.NEAR:
        x0, x1 = outline(view[at.CENTER_X] / cell, f, c.x, c.z, r, pool.shape[2])
        y0, y1 = outline(view[at.CENTER_Y] / cell, f, -c.y, c.z, r, pool.shape[1])
        for y in range(y0, y1):
            for x in range(x0, x1):
                ray = ray_through(view, (x + 0.5) * cell, (y + 0.5) * cell)
                along, length = ray.dot(c), ray.dot(ray)
                inside = along * along - length * (c.dot(c) - r * r)
                if inside > 0:
                    half = ti.sqrt(inside) / length
                    front, back = along / length - half, along / length + half
                    wall = farthest(depth, cell, y, x)
                    if front < wall:
                        pool[0, y, x] = ti.min(pool[0, y, x], front)
                        within = ti.min(back, wall) - front
                        pool[1, y, x] += within * ti.sqrt(length) * at.SHARE


@ti.func
def smooth(view: Array, pool: Array, cell, start: ti.template(), dx, dy, wide, box):
    """Smooth along rows or columns; reads layers `start` and `start` + 1, writes the other two.

    A single particle keeps its shape: only places with several particles behind each other are
    smoothed. `wide` is the half width in particle radii, sampled at TAPS positions on each side,
    inside `box`: the fluid's first and past-the-last column and row.
    """
    grain, focal = view[at.GRAIN], view[at.FOCAL] / cell
    for y in range(box[2], box[3]):
        for x in range(box[0], box[1]):
            here, thick = pool[start, y, x], pool[start + 1, y, x]
            pool[2 - start, y, x], pool[3 - start, y, x] = here, thick
            bulk = ti.math.smoothstep(1.5 * at.SHARE, 4 * at.SHARE, thick / grain)
            if here < FAR and bulk > 0:
                stride = ti.max(1, int(wide * grain * focal / (here * TAPS) + 0.5))
                total, deep, much = 0.0, 0.0, 0.0
                for k in range(-TAPS, TAPS + 1):
                    j, i = y + k * dy * stride, x + k * dx * stride
                    if i >= box[0] and j >= box[2] and i < box[1] and j < box[3]:
                        there = pool[start, j, i]
                        if ti.abs(there - here) < 4 * grain:
                            weight = 1 - (k / (TAPS + 1.0)) ** 2
                            total += weight
                            deep += weight * there
                            much += weight * pool[start + 1, j, i]
                pool[2 - start, y, x] = here + bulk * (deep / total - here)
                pool[3 - start, y, x] = thick + bulk * (much / total - thick)


@ti.func
def slope(before, here, after):
    """Depth difference to a neighbour on the same surface: the smaller of the two sides."""
    up, down = after - here, here - before
    step = up if ti.abs(up) < ti.abs(down) else down
    return step if ti.abs(step) < FAR / 2 else 0.0


@ti.func
def surface_normal(view: Array, pool: Array, cell, y, x):
    """Normal of the fluid's surface at a cell, in camera coordinates, towards the eye."""
    here, width, height = pool[0, y, x], pool.shape[2] - 1, pool.shape[1] - 1
    du = slope(pool[0, y, ti.max(x - 1, 0)], here, pool[0, y, ti.min(x + 1, width)])
    dv = slope(pool[0, ti.max(y - 1, 0), x], here, pool[0, ti.min(y + 1, height), x])
    ray, pitch = ray_through(view, (x + 0.5) * cell, (y + 0.5) * cell), cell / view[at.FOCAL]
    across = Vec3(pitch, 0.0, 0.0) * (here + du) + ray * du
    along = Vec3(0.0, -pitch, 0.0) * (here + dv) + ray * dv
    return across.cross(along).normalized(1e-12)


@ti.func
def extent(bounds: Array, p, cell, width, height):
    """The cells that part p can cover: first and past-the-last column and row."""
    x0, x1 = span(bounds[p, 0] / cell, bounds[p, 1] / cell, width)
    y0, y1 = span(bounds[p, 2] / cell, bounds[p, 3] / cell, height)
    return ti.Vector([x0, x1, y0, y1])


@ti.func
def draw_fluid(
    view: Array, table: Array, balls: Array, bounds: Array, cell, depth: Array, pool: Array
):
    """Fill `pool`, which must be empty, with the surface of the visible fluid."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == FLUID:
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                splat_drop(view, balls, s, cell, depth, pool)
            box = extent(bounds, p, cell, pool.shape[2], pool.shape[1])
            for k in ti.static(range(len(WIDTHS))):
                smooth(view, pool, cell, 0, 1, 0, WIDTHS[k], box)
                smooth(view, pool, cell, 2, 0, 1, WIDTHS[k], box)


@ti.func
def drain(table: Array, bounds: Array, cell, pool: Array):
    """Empty the pool where the fluid is."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == FLUID:
            box = extent(bounds, p, cell, pool.shape[2], pool.shape[1])
            for y in range(box[2], box[3]):
                for x in range(box[0], box[1]):
                    for k in ti.static(range(4)):
                        pool[k, y, x] = FAR if k % 2 == 0 else 0.0
