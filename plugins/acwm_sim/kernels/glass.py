"""Glass: thin transparent walls whose surfaces tint and mirror light.

Light is computed at the vertices and interpolated. Drawing order matters only relative to the
fluid, so glass in front of it and behind it is collected separately. Arrays:

    glow  [V, 6]        per vertex: what it adds to `panes`
    panes [2, H, W, 6]  per pixel, in front of the fluid and behind it: optical density (three
                        colours) and added light
    front [2, R, C]     per sample: depth of the nearest glass, FAR where there is none; its id
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec3
from acwm_sim.kernels.raster import areas, corner, covers, span, to_world
from acwm_sim.kernels.tiles import ray_through
from acwm_sim.kernels.transparency import fresnel, mirrored, path
from acwm_sim.parts import GLASS, INSTANCE, KIND, TRI_0, TRI_1, VERT_0, VERT_1, VISIBLE


@ti.func
def glow_vertex(view: Array, vertices: Array, points: Array, glow: Array, v):
    """Compute the optical density and reflected light of the glass at one vertex."""
    ray = to_world(view, ray_through(view, points[v, 0], points[v, 1])).normalized()
    n = corner(points, v, 3).normalized(1e-9)
    cosine = ti.abs(n.dot(ray))
    share = fresnel(cosine, 0.04)
    light = share * mirrored(view, ray - 2 * n.dot(ray) * n)
    for k in ti.static(range(3)):
        tint = -ti.log(ti.max(vertices[v, 6 + k], 1e-4))
        glow[v, k], glow[v, 3 + k] = tint * path(cosine) - ti.log(1 - share), light[k]


@ti.func
def pixel_span(w, grow, x0, x1, rate):
    """First and past-the-last pixel of a row that a triangle can touch.

    `w` holds the barycentric coordinates, with slack, at column 0 of the row; `grow` is their
    change per sample.
    """
    low, high = float(x0), float(x1)
    for k in ti.static(range(3)):
        if grow[k] > 1e-9:
            low = ti.max(low, -w[k] / grow[k])
        elif grow[k] < -1e-9:
            high = ti.min(high, -w[k] / grow[k])
    first = int(ti.max(low / rate - 1.0, float(x0 // rate)))
    return first, int(ti.min(high / rate + 1.0, float((x1 + rate - 1) // rate)))


@ti.func
def count_samples(
    view: Array, a, b, c, area, w, grow, climb, d, instance,
    depth: Array, pool: Array, front: Array, cell, rate, row, column,
):  # fmt: skip
    """Number of samples of a pixel that show a triangle in front of the fluid, and behind it.

    `w` holds the barycentric coordinates at the pixel's middle, `grow` and `climb` their change per
    sample to the right and down. `d` is the depth in the middle, used for all samples of the pixel.
    """
    before, behind, middle = 0, 0, 0.5 * (rate - 1)
    whole = (w - middle * (ti.abs(grow) + ti.abs(climb))).min() > 0
    for s in range(rate * rate):
        v, u = s // rate, s % rate
        y, x = row * rate + v, column * rate + u
        share = w + grow * (u - middle) + climb * (v - middle)
        if d < depth[0, y, x] and (whole or covers(a, b, c, share, area)):
            if d > pool[0, y // cell, x // cell] + 1.4 * view[at.GRAIN]:
                behind += 1
            else:
                before += 1
            if d < front[0, y, x]:
                front[0, y, x], front[1, y, x] = d, instance
    return before, behind


@ti.func
def add_light(glow: Array, i, j, k, w, share, panes: Array, layer, row, column):
    """Add the effect of a triangle on a share of a pixel to a layer of `panes`."""
    inside = ti.math.clamp(w, 0.0, 1.0)
    inside *= share / inside.sum()
    for q in ti.static(range(6)):
        much = inside.x * glow[i, q] + inside.y * glow[j, q] + inside.z * glow[k, q]
        panes[layer, row, column, q] += much


@ti.func
def draw_pane(
    view: Array,
    points: Array,
    glow: Array,
    corners,
    instance,
    depth: Array,
    pool: Array,
    panes: Array,
    front: Array,
    tiles: Array,
    side,
    cell,
    rate,
):
    """Add one triangle to the pixels of marked tiles where nothing opaque hides it."""
    i, j, k = corners[0], corners[1], corners[2]
    a, b, c = corner(points, i, 0), corner(points, j, 0), corner(points, k, 0)
    area = areas(a, b, c, a.x, a.y).sum()
    if ti.min(a.z, b.z, c.z) > at.NEAR and ti.abs(area) > 1e-9:
        x0, x1 = span(ti.min(a.x, b.x, c.x), ti.max(a.x, b.x, c.x), depth.shape[2])
        y0, y1 = span(ti.min(a.y, b.y, c.y), ti.max(a.y, b.y, c.y), depth.shape[1])
        inverse = Vec3(1 / a.z, 1 / b.z, 1 / c.z)
        grow = Vec3(b.y - c.y, c.y - a.y, a.y - b.y) / area
        climb = Vec3(c.x - b.x, a.x - c.x, b.x - a.x) / area
        # Samples may lie inside even if the pixel's middle is up to half a diagonal outside.
        slack = 0.5 * rate * (ti.abs(grow) + ti.abs(climb))
        for row in range(y0 // rate, (y1 + rate - 1) // rate):
            start = areas(a, b, c, 0.0, (row + 0.5) * rate) / area
            first, last = pixel_span(start + slack, grow, x0, x1, rate)
            for column in range(first, last):
                w = start + grow * ((column + 0.5) * rate)
                meets = (w + slack).min() >= 0
                if meets and tiles[row * rate // side, column * rate // side] & 1:
                    inside = ti.math.clamp(w, 0.0, 1.0)
                    d = inside.sum() / inside.dot(inverse)
                    before, behind = count_samples(
                        view, a, b, c, area, w, grow, climb, d, instance,
                        depth, pool, front, cell, rate, row, column,
                    )  # fmt: skip
                    if before > 0:
                        add_light(glow, i, j, k, w, before / rate**2, panes, 0, row, column)
                    if behind > 0:
                        add_light(glow, i, j, k, w, behind / rate**2, panes, 1, row, column)


@ti.func
def draw_glass(
    view: Array,
    table: Array,
    vertices: Array,
    triangles: Array,
    points: Array,
    glow: Array,
    depth: Array,
    pool: Array,
    panes: Array,
    front: Array,
    tiles: Array,
    side,
    cell,
    rate,
):
    """Draw all visible glass of a table; `pool` must hold the fluid, if there is any."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == GLASS:
            for v in range(table[p, VERT_0], table[p, VERT_1]):
                glow_vertex(view, vertices, points, glow, v)
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                corners = ti.Vector([triangles[t, 0], triangles[t, 1], triangles[t, 2]])
                draw_pane(
                    view, points, glow, corners, table[p, INSTANCE],
                    depth, pool, panes, front, tiles, side, cell, rate,
                )  # fmt: skip


@ti.func
def through(panes: Array, layer, row, column, light):
    """Light from behind a layer of glass, after passing through it."""
    result = light
    for k in ti.static(range(3)):
        keep = ti.exp(-panes[layer, row, column, k])
        result[k] = result[k] * keep + panes[layer, row, column, 3 + k]
    return result
