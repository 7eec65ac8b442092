"""Find the tiles of the frame that must be drawn again.

The frame is divided into square tiles, `side` samples wide. Only tiles that a moving part, its
shadow or its ambient occlusion can reach are redrawn; the others keep the static scene. Arrays:

    tiles   [ty, tx]     REDRAW, LAY or RESTORE; 0 if there is nothing to do
    still   [ty, tx, 7]  the static scene in a tile: least and largest shadow column, shadow row
                         and depth; 1 if any of it is occluded
    deep    [ty, tx, 4]  least and largest depth of opaque moving parts in a tile, and in nearby
                         tiles of its row; FAR and −FAR before a frame
    marks   [ty, tx]     bits that say what moves in a tile; zero before a frame
    cells   [64, 64]     1 if a moving part lies in a cell of the shadow map; zero before a frame
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec2, Vec3, get3
from acwm_sim.kernels.raster import (
    FAR,
    areas,
    corner,
    row3,
    span,
    to_camera,
    to_frame,
    to_light,
)
from acwm_sim.parts import BALL_0, BALL_1, KIND, OPAQUE, SOLID, TRI_0, TRI_1, VISIBLE

REDRAW, RESTORE, LAY = 1, 2, 3
"""What to do with a tile: draw it again; restore the static scene, because the previous frame
changed it; or restore it and draw only glass or fluid over it."""

HOLDS_OPAQUE, HOLDS_CLEAR = 1, 2
"""Bits of a mark: the tile holds an opaque part; it holds glass or fluid."""

AO_DEPTH = 4
"""Surfaces further apart than this many times the reach of occlusion do not occlude each other."""


@ti.func
def ray_through(view: Array, column, row):
    """Camera direction with depth 1 through a point of the sample grid."""
    focal = view[at.FOCAL]
    return Vec3((column - view[at.CENTER_X]) / focal, (view[at.CENTER_Y] - row) / focal, 1.0)


@ti.func
def touch(grid: Array, size, low, high, mark):
    """Mark the cells of a grid, each `size` wide, that a rectangle touches."""
    x0, x1 = span(low.x / size, high.x / size, grid.shape[1])
    y0, y1 = span(low.y / size, high.y / size, grid.shape[0])
    for y in range(y0, y1):
        for x in range(x0, x1):
            grid[y, x] |= mark


@ti.func
def touch_triangle(grid: Array, size, a, b, c, mark):
    """Mark the cells that a triangle may touch; large triangles do not mark their whole box."""
    low, high = ti.min(a, b, c) - 1, ti.max(a, b, c) + 1
    if ti.max(high.x - low.x, high.y - low.y) < 3 * size:
        touch(grid, size, low, high, mark)
    else:
        x0, x1 = span(low.x / size, high.x / size, grid.shape[1])
        y0, y1 = span(low.y / size, high.y / size, grid.shape[0])
        turn = 1.0 if areas(a, b, c, a.x, a.y).sum() > 0 else -1.0
        longest = Vec3((c - b).norm(), (a - c).norm(), (b - a).norm())
        for y in range(y0, y1):
            for x in range(x0, x1):
                inward = turn * areas(a, b, c, (x + 0.5) * size, (y + 0.5) * size)
                if (inward + longest * (0.8 * size + 1)).min() >= 0:
                    grid[y, x] |= mark


@ti.func
def sink(deep: Array, size, low, high, near, far):
    """Widen the range of depths in the tiles that a rectangle touches."""
    x0, x1 = span(low.x / size, high.x / size, deep.shape[1])
    y0, y1 = span(low.y / size, high.y / size, deep.shape[0])
    for y in range(y0, y1):
        for x in range(x0, x1):
            deep[y, x, 0] = ti.min(deep[y, x, 0], near)
            deep[y, x, 1] = ti.max(deep[y, x, 1], far)


@ti.func
def touch_parts(
    view: Array,
    table: Array,
    triangles: Array,
    balls: Array,
    points: Array,
    side,
    marks: Array,
    deep: Array,
    cells: Array,
    cell,
):
    """Mark where visible parts lie in the frame and in the shadow map."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1:
            mark = HOLDS_OPAQUE if table[p, KIND] == OPAQUE else HOLDS_CLEAR
            solid = table[p, SOLID] == 1
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                a, b, c = corner(points, i, 0), corner(points, j, 0), corner(points, k, 0)
                # For a solid, draw only what faces the eye; only what faces the light casts shadow.
                faces = not solid or areas(a, b, c, a.x, a.y).sum() < 0
                if faces and ti.min(a.z, b.z, c.z) > at.NEAR:
                    touch_triangle(marks, side, a.xy, b.xy, c.xy, mark)
                    if mark == HOLDS_OPAQUE:
                        low, high = ti.min(a, b, c) - 1, ti.max(a, b, c) + 1
                        sink(deep, side, low, high, low.z + 1, high.z - 1)
                a, b, c = corner(points, i, 6), corner(points, j, 6), corner(points, k, 6)
                if not solid or areas(a, b, c, a.x, a.y).sum() > 0:
                    touch_triangle(cells, cell, a.xy, b.xy, c.xy, 1)
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                center, r = get3(balls, s), balls[s, 3]
                here = to_frame(view, to_camera(view, center - row3(view, at.EYE)))
                reach = 1.3 * r * view[at.FOCAL] / ti.max(here.z - r, at.NEAR) + 1
                touch(marks, side, here.xy - reach, here.xy + reach, mark)
                if mark == HOLDS_OPAQUE:
                    sink(deep, side, here.xy - reach, here.xy + reach, here.z - r, here.z + r)
                light, shade = to_light(view, center), r * view[at.TEXEL] + 1
                touch(cells, cell, light.xy - shade, light.xy + shade, 1)


@ti.func
def any_touched(grid: Array, size, low, high):
    """Whether a rectangle touches a marked cell of a grid."""
    x0, x1 = span(low.x / size, high.x / size, grid.shape[1])
    y0, y1 = span(low.y / size, high.y / size, grid.shape[0])
    found = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            found |= grid[y, x]
    return found


@ti.func
def spread_depths(deep: Array, wide):
    """Collect the depths of opaque parts that are at most `wide` tiles away in the same row."""
    for ty in range(deep.shape[0]):
        for tx in range(deep.shape[1]):
            for x in range(ti.max(tx - wide, 0), ti.min(tx + wide + 1, deep.shape[1])):
                deep[ty, tx, 2] = ti.min(deep[ty, tx, 2], deep[ty, x, 0])
                deep[ty, tx, 3] = ti.max(deep[ty, tx, 3], deep[ty, x, 1])


@ti.func
def occludes(view: Array, still: Array, deep: Array, wide, ty, tx):
    """Whether opaque parts at most `wide` tiles away can change a tile's ambient occlusion.

    They cannot if the static scene is further from them than occlusion reaches, unless they hide
    something else that occludes it.
    """
    near, far = FAR, -FAR
    for y in range(ti.max(ty - wide, 0), ti.min(ty + wide + 1, deep.shape[0])):
        near, far = ti.min(near, deep[y, tx, 2]), ti.max(far, deep[y, tx, 3])
    gap = ti.max(near - still[ty, tx, 5], still[ty, tx, 4] - far)
    return near < FAR and (still[ty, tx, 6] > 0 or gap < AO_DEPTH * view[at.AO_RADIUS])


@ti.func
def mark_tiles(
    view: Array,
    table: Array,
    triangles: Array,
    balls: Array,
    points: Array,
    bounds: Array,
    still: Array,
    side,
    tiles: Array,
    marks: Array,
    deep: Array,
    cells: Array,
    cell,
):
    """Find the tiles that visible parts can change now, or changed in the previous frame."""
    near = FAR
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == OPAQUE:
            near = ti.min(near, bounds[p, 8])
    touch_parts(view, table, triangles, balls, points, side, marks, deep, cells, cell)
    reach = view[at.AO_RADIUS] * view[at.FOCAL] / ti.max(near, at.NEAR) + 1
    wide = int(ti.ceil(reach / side))
    spread_depths(deep, wide)
    ti.loop_config(serialize=True)
    for ty in range(tiles.shape[0]):
        for tx in range(tiles.shape[1]):
            blur = view[at.BLUR] + 2
            first = Vec2(still[ty, tx, 0], still[ty, tx, 2]) - blur
            last = Vec2(still[ty, tx, 1], still[ty, tx, 3]) + blur
            if (
                marks[ty, tx] & HOLDS_OPAQUE
                or occludes(view, still, deep, wide, ty, tx)
                or (first.x <= last.x and any_touched(cells, cell, first, last))
            ):
                tiles[ty, tx] = REDRAW
            elif marks[ty, tx] & HOLDS_CLEAR:
                tiles[ty, tx] = LAY
            else:
                tiles[ty, tx] = RESTORE if tiles[ty, tx] & 1 else 0


@ti.func
def restore_tiles(tiles: Array, side, depth: Array, surface: Array, label: Array):
    """Restore the static scene where the previous frame drew something."""
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
