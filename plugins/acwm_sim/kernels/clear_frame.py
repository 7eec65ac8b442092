"""The kernel that draws glass and fluid over an opaque frame.

Arrays are those of `raster`, `fluid` and `glass`, and

    base [2, H, W, 3]  linear light of the opaque parts: 0 this frame, 1 the static scene
    bare [H, W]        mask of the static scene without its glass
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, F3, F4, I2, U1, U2, U3, Array, Vec2, Vec3
from acwm_sim.kernels.fluid import drain, draw_fluid, surface_normal
from acwm_sim.kernels.glass import draw_glass, through
from acwm_sim.kernels.raster import FAR, row3, to_world
from acwm_sim.kernels.shading import visibility
from acwm_sim.kernels.tiles import ray_through
from acwm_sim.kernels.transparency import fresnel, mirrored
from acwm_sim.parts import FLUID, INSTANCE, KIND

BEND = 0.25
"""Strength of refraction in water: 1 − 1/1.33, with its refractive index 1.33."""


@ti.func
def wet(view: Array, depth: Array, pool: Array, cell, rate, row, column):
    """Share of a pixel that shows fluid, and the fluid's mean depth, thickness and normal there."""
    total, z, thick, normal, side = 0.0, 0.0, 0.0, Vec3(0.0), rate // cell
    for q in range(side * side):
        y, x, count = row * side + q // side, column * side + q % side, 0.0
        if pool[0, y, x] < FAR:
            for s in range(cell * cell):
                if pool[0, y, x] < depth[0, y * cell + s // cell, x * cell + s % cell]:
                    count += 1
        if count > 0:
            # Less of the cell is covered where the fluid is thinner than half a particle.
            count *= ti.min(pool[1, y, x] / (view[at.GRAIN] * at.SHARE), 1.0)
            total += count
            z += count * pool[0, y, x]
            thick += count * pool[1, y, x]
            normal += count * surface_normal(view, pool, cell, y, x)
    some = ti.max(total, 1e-6)
    return total / rate**2, z / some, thick / some, normal.normalized(1e-9)


@ti.func
def background(depth: Array, base: Array, panes: Array, rate, z, u, v):
    """Light behind the fluid at column u, row v in pixels, mixed from four pixels.

    Returns:
        The light, and whether all four pixels show something behind depth z.
    """
    x0, y0 = int(ti.floor(u - 0.5)), int(ti.floor(v - 0.5))
    total, good = Vec3(0.0), 1
    for q in ti.static(range(4)):
        x = ti.math.clamp(x0 + q % 2, 0, base.shape[2] - 1)
        y = ti.math.clamp(y0 + q // 2, 0, base.shape[1] - 1)
        weight = 1 - ti.abs(u - 0.5 - (x0 + q % 2))
        weight *= 1 - ti.abs(v - 0.5 - (y0 + q // 2))
        if depth[0, y * rate + rate // 2, x * rate + rate // 2] < z:
            good = 0
        light = Vec3(base[0, y, x, 0], base[0, y, x, 1], base[0, y, x, 2])
        total += weight * through(panes, 1, y, x, light)
    return total, good


@ti.func
def refracted(view: Array, depth: Array, base: Array, panes: Array, rate, row, column, z, thick, n):
    """The light seen through the fluid, along the ray refracted at its surface."""
    shift = Vec2(n.x, -n.y) * (BEND * thick * view[at.FOCAL] / (z * rate))
    most = 0.12 * base.shape[1]
    shift *= ti.min(1.0, most / ti.max(shift.norm(), 1e-6))
    u, v = column + 0.5, row + 0.5
    light, good = background(depth, base, panes, rate, z, u - shift.x, v - shift.y)
    if good == 0:
        light, good = background(depth, base, panes, rate, 0.0, u, v)
    return light


@ti.func
def fluid_light(
    view: Array, depth: Array, shadow: Array, base: Array, panes: Array,
    rate, row, column, z, thick, seen,
):  # fmt: skip
    """Linear colour of the fluid in a pixel; `seen` is its normal in camera coordinates."""
    ray = to_world(view, ray_through(view, (column + 0.5) * rate, (row + 0.5) * rate))
    n, toward, sun = to_world(view, seen), -ray.normalized(), -row3(view, at.DEEP)
    clear = visibility(view, shadow, row3(view, at.EYE) + ray * z, n, True)
    back = refracted(view, depth, base, panes, rate, row, column, z, thick, seen)
    left = ti.exp(-row3(view, at.ABSORB) * thick)
    murk = 1 - ti.exp(-view[at.HAZE] * thick)
    up = 0.5 + 0.5 * n.z
    around = row3(view, at.SKY) * up + row3(view, at.BOUNCE) * (1 - up)
    wrap = 0.35 + 0.65 * ti.max(n.dot(sun), 0.0)
    body = row3(view, at.BODY) * (around + row3(view, at.SUN) * (wrap * (0.3 + 0.7 * clear)))
    share = fresnel(ti.max(n.dot(toward), 0.0), 0.02)
    bounced = mirrored(view, 2 * n.dot(toward) * n - toward)
    glint = 0.6 * clear * ti.max(n.dot((sun + toward).normalized()), 0.0) ** 90
    light = back * left * (1 - murk) + body * murk
    return light * (1 - share) + bounced * share + row3(view, at.SUN) * glint


@ti.func
def owner(depth: Array, pool: Array, front: Array, rate, row, column):
    """Id of the nearest glass in a pixel if glass covers at least half of it, else 0."""
    count, near, found = 0, FAR, 0
    for s in range(rate * rate):
        y, x = row * rate + s // rate, column * rate + s % rate
        if front[0, y, x] < FAR:
            count += 1
            if front[0, y, x] < near:
                near, found = front[0, y, x], int(front[1, y, x])
    return found if 2 * count >= rate * rate else 0


@ti.func
def compose(
    view: Array, fluid_id, depth: Array, shadow: Array, base: Array, pool: Array, panes: Array,
    front: Array, gamma: Array, cell, rate, row, column, frame: Array, mask: Array,
):  # fmt: skip
    """Compose one pixel from back to front: opaque parts, glass, fluid, glass."""
    bare = Vec3(base[0, row, column, 0], base[0, row, column, 1], base[0, row, column, 2])
    light = through(panes, 1, row, column, bare)
    share, z, thick, normal = wet(view, depth, pool, cell, rate, row, column)
    if share > 0:
        fluid = fluid_light(view, depth, shadow, base, panes, rate, row, column, z, thick, normal)
        light += share * (fluid - light)
        if share >= 0.5:
            mask[row, column] = ti.cast(fluid_id, ti.u8)
    light = through(panes, 0, row, column, light)
    for k in ti.static(range(3)):
        level = ti.math.clamp(light[k], 0.0, 1.0)
        frame[row, column, k] = gamma[int(level * (gamma.shape[0] - 1))]
    if mask[row, column] == 0:
        mask[row, column] = ti.cast(owner(depth, pool, front, rate, row, column), ti.u8)


@ti.func
def is_clear(pool: Array, panes: Array, side, row, column):
    """Whether a pixel, `side` cells wide, contains any glass or fluid."""
    some = panes[0, row, column, 0] + panes[1, row, column, 0] > 0
    for s in range(side * side):
        some |= pool[0, row * side + s // side, column * side + s % side] < FAR
    return some


@ti.func
def clear_pixel(panes: Array, front: Array, rate, row, column):
    """Clear the glass arrays of one pixel."""
    for k in ti.static(range(6)):
        panes[0, row, column, k] = 0.0
        panes[1, row, column, k] = 0.0
    for s in range(rate * rate):
        front[0, row * rate + s // rate, column * rate + s % rate] = FAR


@ti.kernel
def draw_clear(
    view: F1,
    table: I2,
    vertices: F2,
    triangles: I2,
    balls: F2,
    points: F2,
    bounds: F2,
    glow: F2,
    still_table: I2,
    still_vertices: F2,
    still_triangles: I2,
    still_points: F2,
    still_glow: F2,
    depth: F3,
    shadow: F3,
    base: F4,
    pool: F3,
    panes: F4,
    front: F3,
    tiles: I2,
    gamma: U1,
    frame: U3,
    mask: U2,
    side: ti.template(),
    cell: ti.template(),
    rate: ti.template(),
):
    """Draw the moving fluid, and moving and static glass, over the marked tiles of a frame."""
    draw_fluid(view, table, balls, bounds, cell, depth, pool)
    draw_glass(
        view, table, vertices, triangles, points, glow,
        depth, pool, panes, front, tiles, side, cell, rate,
    )  # fmt: skip
    draw_glass(
        view, still_table, still_vertices, still_triangles, still_points, still_glow,
        depth, pool, panes, front, tiles, side, cell, rate,
    )  # fmt: skip
    fluid_id = 0
    for p in range(table.shape[0]):
        if table[p, KIND] == FLUID:
            fluid_id = table[p, INSTANCE]
    pixels = side // rate
    for stage in ti.static(range(2)):
        ti.loop_config(serialize=True)
        for tile in range(tiles.shape[0] * tiles.shape[1]):
            ty, tx = tile // tiles.shape[1], tile % tiles.shape[1]
            if tiles[ty, tx] & 1:
                for row in range(ty * pixels, ti.min((ty + 1) * pixels, frame.shape[0])):
                    for column in range(tx * pixels, ti.min((tx + 1) * pixels, frame.shape[1])):
                        if is_clear(pool, panes, rate // cell, row, column):
                            if ti.static(stage == 0):
                                compose(
                                    view, fluid_id, depth, shadow, base, pool, panes, front,
                                    gamma, cell, rate, row, column, frame, mask,
                                )  # fmt: skip
                            else:
                                clear_pixel(panes, front, rate, row, column)
    drain(table, bounds, cell, pool)
