"""The kernel that draws the opaque parts of a frame: one launch, as each costs as a small part.

Arrays are those of `acwm_sim.raster`, `acwm_sim.tiles`, `acwm_sim.shading` and, where glass or
fluid needs it, `base` and `bare` of `acwm_sim.clear`.
"""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim.arrays import F1, F2, F3, F4, I2, I3, U1, U2, U3
from acwm_sim.engine import ti
from acwm_sim.opaque import cast_parts, draw_parts
from acwm_sim.raster import place_parts
from acwm_sim.shading import restore_base, shade_tile
from acwm_sim.tiles import LAY, REDRAW, mark_tiles, restore_tiles
from acwm_sim.veil import LAYERS, cast_clear


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

    `first` is the number of the first part. With `everything`, the tiles are taken as marked.
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
