"""The kernels that draw the opaque parts of a frame, and measure the static scene once for `tiles`.

A frame is a single launch, as each launch costs as much as drawing a small part. Arrays are those
of `raster`, `tiles`, `shading` and, if there is glass or fluid, `base` and `bare` of `clear_frame`.
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, F3, F4, I2, I3, U1, U2, U3, Array, Vec3
from acwm_sim.kernels.raster import (
    FAR,
    cast_ball,
    cast_triangle,
    corner,
    draw_ball,
    draw_triangle,
    place_parts,
    row3,
    to_camera,
    to_light,
    to_world,
)
from acwm_sim.kernels.shading import openness, restore_base, shade_tile
from acwm_sim.kernels.tiles import LAY, REDRAW, mark_tiles, ray_through, restore_tiles
from acwm_sim.kernels.transparency import LAYERS, cast_clear
from acwm_sim.parts import BALL_0, BALL_1, INSTANCE, KIND, OPAQUE, SOLID, TRI_0, TRI_1, VISIBLE


@ti.func
def draw_parts(
    view: Array,
    table: Array,
    vertices: Array,
    triangles: Array,
    balls: Array,
    points: Array,
    first,
    depth: Array,
    surface: Array,
    label: Array,
):
    """Draw all visible opaque parts into the sample grid; labels count parts from `first`."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == OPAQUE:
            mark = (first + p) * 256 + table[p, INSTANCE]
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                draw_triangle(
                    vertices, points, i, j, k, table[p, SOLID], mark, depth, surface, label
                )
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                draw_ball(view, balls, s, mark, depth, surface, label)


@ti.func
def cast_parts(
    view: Array, table: Array, triangles: Array, balls: Array, points: Array, shadow: Array
):
    """Draw all visible opaque parts into the shadow map."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == OPAQUE:
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                a, b, c = corner(points, i, 6), corner(points, j, 6), corner(points, k, 6)
                cast_triangle(a, b, c, table[p, SOLID], shadow)
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                cast_ball(view, balls, s, shadow)


@ti.kernel
def draw_frame(
    view: F1,
    table: I2,
    pose: F2,
    vertices: F2,
    triangles: I2,
    balls: F2,
    points: F2,
    bounds: F2,
    depth: F3,
    surface: F4,
    label: I3,
    shadow: F3,
    still: F3,
    tiles: I2,
    marks: I2,
    deep: F3,
    cells: I2,
    gamma: U1,
    base: F4,
    bare: U2,
    frame: U3,
    mask: U2,
    side: ti.template(),
    rate: ti.template(),
    first: ti.i32,
    everything: ti.i32,
):
    """Draw parts over the static scene, and redraw the tiles of `frame` and `mask` they change.

    `first` is the number of the first part. With `everything`, `tiles` is used as it is.
    """
    place_parts(view, table, pose, vertices, balls, points, bounds)
    cast_parts(view, table, triangles, balls, points, shadow)
    if shadow.shape[0] == LAYERS:
        cast_clear(view, table, vertices, triangles, balls, points, shadow)
    if everything == 0:
        mark_tiles(
            view, table, triangles, balls, points, bounds, still, side, tiles, marks, deep, cells,
            shadow.shape[1] / cells.shape[0],
        )  # fmt: skip
        restore_tiles(tiles, side, depth, surface, label)
    draw_parts(view, table, vertices, triangles, balls, points, first, depth, surface, label)
    ti.loop_config(serialize=True)
    for ty in range(tiles.shape[0]):
        for tx in range(tiles.shape[1]):
            if tiles[ty, tx] == REDRAW:
                shade_tile(
                    view, depth, surface, label, shadow, gamma, side // rate, rate, ty, tx,
                    base, frame, mask,
                )  # fmt: skip
            elif tiles[ty, tx] != 0 and base.shape[0] == 2:
                restore_base(side // rate, ty, tx, tiles[ty, tx] == LAY, base, bare, mask)


@ti.func
def is_occluded(view: Array, depth: Array, surface: Array, y, x):
    """Whether nearby surfaces hide part of the sky from a sample."""
    ray = to_world(view, ray_through(view, x + 0.5, y + 0.5))
    n = Vec3(surface[0, y, x, 0], surface[0, y, x, 1], surface[0, y, x, 2])
    if n.dot(ray) > 0:
        n = -n
    return openness(view, depth, x + 0.5, y + 0.5, depth[0, y, x], to_camera(view, n), 1) < 1


@ti.kernel
def measure_tiles(view: F1, depth: F3, surface: F4, side: ti.i32, still: F3):
    """Fill `still`; layer 0 of `depth` and `surface` must be the static scene."""
    ti.loop_config(serialize=True)
    for ty in range(still.shape[0]):
        for tx in range(still.shape[1]):
            low, high, occluded = Vec3(FAR), Vec3(-FAR), 0
            near, far = FAR, -FAR
            for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[1])):
                for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[2])):
                    if depth[0, y, x] < FAR:
                        ray = to_world(view, ray_through(view, x + 0.5, y + 0.5))
                        p = to_light(view, row3(view, at.EYE) + ray * depth[0, y, x])
                        low, high = ti.min(low, p), ti.max(high, p)
                        near, far = ti.min(near, depth[0, y, x]), ti.max(far, depth[0, y, x])
                        occluded |= is_occluded(view, depth, surface, y, x)
            for k in ti.static(range(2)):
                still[ty, tx, 2 * k] = low[k]
                still[ty, tx, 2 * k + 1] = high[k]
            still[ty, tx, 4] = near
            still[ty, tx, 5] = far
            still[ty, tx, 6] = occluded
