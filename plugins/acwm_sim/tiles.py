"""Which parts of the frame must be drawn again.

The frame is cut into square tiles, `side` samples wide. Only those that a moving part, its shadow
or its ambient occlusion can reach are redrawn; the others keep what the static scene gave them.

    tiles   [ty, tx]     1 to redraw now, 2 to restore only (it was redrawn last time), else 0
    lit     [ty, tx, 4]  least and largest shadow column and row of the static scene in a tile
"""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.parts import VISIBLE
from acwm_sim.raster import F1, F3, FAR, Array, Vec3, row3, to_light, to_world


@ti.func
def ray_through(view: Array, column, row):
    """Camera direction, of unit depth, through a point of the sample grid."""
    focal = view[at.FOCAL]
    return Vec3((column - view[at.CENTER_X]) / focal, (view[at.CENTER_Y] - row) / focal, 1.0)


@ti.func
def overlap(bounds: Array, part, start: ti.template(), margin, x0, x1, y0, y1):
    """Whether a part's bounds from `start` on, grown by a margin, meet a rectangle."""
    return (
        bounds[part, start] - margin < x1
        and bounds[part, start + 1] + margin > x0
        and bounds[part, start + 2] - margin < y1
        and bounds[part, start + 3] + margin > y0
    )


@ti.func
def mark_tiles(view: Array, table: Array, bounds: Array, lit: Array, side, tiles: Array):
    """Find the tiles that visible parts can change, now or in the frame before."""
    ti.loop_config(serialize=True)
    for ty in range(tiles.shape[0]):
        for tx in range(tiles.shape[1]):
            tiles[ty, tx] = 2 if tiles[ty, tx] == 1 else 0
            x, y, blur = tx * side, ty * side, view[at.BLUR] + 2
            for p in range(table.shape[0]):
                if table[p, VISIBLE] == 1:
                    reach = view[at.AO_RADIUS] * view[at.FOCAL] / ti.max(bounds[p, 8], at.NEAR) + 2
                    if overlap(bounds, p, 0, reach, x, x + side, y, y + side) or overlap(
                        bounds, p, 4, blur, lit[ty, tx, 0], lit[ty, tx, 1],
                        lit[ty, tx, 2], lit[ty, tx, 3],
                    ):  # fmt: skip
                        tiles[ty, tx] = 1


@ti.func
def restore_tiles(tiles: Array, side, depth: Array, surface: Array, label: Array):
    """Put the static scene back where something was drawn in the frame before."""
    ti.loop_config(serialize=True)
    for ty in range(tiles.shape[0]):
        for tx in range(tiles.shape[1]):
            if tiles[ty, tx] != 0:
                for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[1])):
                    for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[2])):
                        if label[0, y, x] != label[1, y, x]:
                            label[0, y, x] = label[1, y, x]
                            depth[0, y, x] = depth[1, y, x]
                            for k in ti.static(range(7)):
                                surface[0, y, x, k] = surface[1, y, x, k]


@ti.kernel
def measure_tiles(view: F1, depth: F3, side: ti.i32, lit: F3):
    """Where each tile of the static scene lies in the shadow map."""
    ti.loop_config(serialize=True)
    for ty in range(lit.shape[0]):
        for tx in range(lit.shape[1]):
            low, high = Vec3(FAR), Vec3(-FAR)
            for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[1])):
                for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[2])):
                    if depth[1, y, x] < FAR:
                        ray = to_world(view, ray_through(view, x + 0.5, y + 0.5))
                        p = to_light(view, row3(view, at.EYE) + ray * depth[1, y, x])
                        low, high = ti.min(low, p), ti.max(high, p)
            for k in ti.static(range(2)):
                lit[ty, tx, 2 * k] = low[k]
                lit[ty, tx, 2 * k + 1] = high[k]
