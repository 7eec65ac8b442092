"""Samples to pixels: Taichi kernels for light, shadow, ambient occlusion and anti-aliasing.

The frame is cut into square tiles. Only tiles that a moving part, its shadow or its ambient
occlusion can reach are redrawn; the others keep what the static scene gave them. Arrays are
those of `acwm_sim.raster`, and:

    tiles   [ty, tx]     1 to redraw now, 2 to restore only (redrawn in the frame before), else 0
    lit     [ty, tx, 4]  least and largest shadow column and row of the static scene in a tile
"""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportArgumentType=false
# pyright: reportOptionalOperand=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.raster import F1, F2, F3, FAR, I2, Vec3, row3, to_light, to_world

U2 = ti.types.ndarray(dtype=ti.u8, ndim=2)
U3 = ti.types.ndarray(dtype=ti.u8, ndim=3)
U1 = ti.types.ndarray(dtype=ti.u8, ndim=1)

TAPS = 4
"""Shadow-map reads along each axis of a shadow's blur."""


@ti.func
def ray_through(view: ti.template(), column, row):
    """World direction, of unit depth, through a point of the sample grid."""
    focal = view[at.FOCAL]
    x, y = (column - view[at.CENTER_X]) / focal, (view[at.CENTER_Y] - row) / focal
    return to_world(view, Vec3(x, y, 1.0))


@ti.kernel
def mark_tiles(view: F1, parts: I2, bounds: F2, lit: F3, side: ti.i32, tiles: I2):
    """Find the tiles, `side` samples wide, that visible parts can change."""
    ti.loop_config(serialize=True)
    for ty, tx in ti.ndrange(tiles.shape[0], tiles.shape[1]):
        tiles[ty, tx] = 2 if tiles[ty, tx] == 1 else 0
        x, y, blur = tx * side, ty * side, view[at.BLUR] + 2
        for p in range(bounds.shape[0]):
            if parts[p, 2] == 1:
                reach = view[at.AO_RADIUS] * view[at.FOCAL] / ti.max(bounds[p, 8], at.NEAR) + 2
                seen = bounds[p, 0] - reach < x + side and bounds[p, 1] + reach > x
                seen = seen and bounds[p, 2] - reach < y + side and bounds[p, 3] + reach > y
                shaded = (
                    bounds[p, 4] - blur < lit[ty, tx, 1] and bounds[p, 5] + blur > lit[ty, tx, 0]
                )
                shaded = shaded and bounds[p, 6] - blur < lit[ty, tx, 3]
                shaded = shaded and bounds[p, 7] + blur > lit[ty, tx, 2]
                if seen or shaded:
                    tiles[ty, tx] = 1


@ti.kernel
def measure_tiles(view: F1, depth: F2, side: ti.i32, lit: F3):
    """Where each tile of the static scene lies in the shadow map."""
    ti.loop_config(serialize=True)
    for ty, tx in ti.ndrange(lit.shape[0], lit.shape[1]):
        for k in ti.static(range(4)):
            lit[ty, tx, k] = FAR if k % 2 == 0 else -FAR
        for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[0])):
            for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[1])):
                if depth[y, x] < FAR:
                    ray = ray_through(view, x + 0.5, y + 0.5)
                    p = to_light(view, row3(view, at.EYE) + ray * depth[y, x])
                    lit[ty, tx, 0] = ti.min(lit[ty, tx, 0], p.x)
                    lit[ty, tx, 1] = ti.max(lit[ty, tx, 1], p.x)
                    lit[ty, tx, 2] = ti.min(lit[ty, tx, 2], p.y)
                    lit[ty, tx, 3] = ti.max(lit[ty, tx, 3], p.y)


@ti.kernel
def restore_tiles(
    tiles: I2,
    side: ti.i32,
    static_depth: F2,
    static_surface: F3,
    static_label: I2,
    depth: F2,
    surface: F3,
    label: I2,
):
    """Put the static scene back wherever something moved, now or in the frame before."""
    ti.loop_config(serialize=True)
    for ty, tx in ti.ndrange(tiles.shape[0], tiles.shape[1]):
        if tiles[ty, tx] != 0:
            for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[0])):
                for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[1])):
                    depth[y, x] = static_depth[y, x]
                    label[y, x] = static_label[y, x]
                    for k in ti.static(range(7)):
                        surface[y, x, k] = static_surface[y, x, k]


@ti.func
def visibility(view: ti.template(), shadow: ti.template(), p, n):
    """Share of the sun that reaches a point, from 0 to 1: the mean over a blurred square."""
    size = shadow.shape[0]
    raised = to_light(view, p + n * (1.5 / view[at.TEXEL]))
    across = row3(view, at.ACROSS).dot(n)
    along = row3(view, at.ALONG).dot(n)
    deep = ti.min(row3(view, at.DEEP).dot(n), -0.1)
    # The receiver's own plane slopes in the map; follow it, or a wide blur would shade itself.
    tilt_x = -across / (deep * view[at.TEXEL] ** 2)
    tilt_y = -along / (deep * view[at.TEXEL] ** 2)
    open_taps = 0.0
    for j in range(TAPS):
        for i in range(TAPS):
            dx = ((i + 0.5) * (2.0 / TAPS) - 1.0) * view[at.BLUR]
            dy = ((j + 0.5) * (2.0 / TAPS) - 1.0) * view[at.BLUR]
            x, y = int(ti.floor(raised.x + dx)), int(ti.floor(raised.y + dy))
            clear = 1.0
            if x >= 0 and y >= 0 and x < size and y < size:
                if shadow[y, x] < raised.z + tilt_x * dx + tilt_y * dy - view[at.BIAS]:
                    clear = 0.0
            open_taps += clear
    return open_taps / (TAPS * TAPS)


@ti.func
def openness(view: ti.template(), depth: ti.template(), disc: ti.template(), x, y, z, p, n):
    """Share of the sky that nearby surfaces leave open, judged from the depth of the samples."""
    reach = view[at.AO_RADIUS]
    spread = reach * view[at.FOCAL] / z
    hidden = 0.0
    for k in range(disc.shape[0]):
        i, j = int(ti.floor(x + disc[k, 0] * spread)), int(ti.floor(y + disc[k, 1] * spread))
        if i >= 0 and j >= 0 and i < depth.shape[1] and j < depth.shape[0]:
            if depth[j, i] < FAR:
                ray = ray_through(view, i + 0.5, j + 0.5)
                to = row3(view, at.EYE) + ray * depth[j, i] - p
                far = to.norm() + 1e-6
                hidden += ti.max(0.0, n.dot(to) / far - 0.08) * ti.max(0.0, 1 - far / (2 * reach))
    return ti.max(0.0, 1 - 2.2 * hidden / disc.shape[0])


@ti.func
def radiance(
    view: ti.template(),
    depth: ti.template(),
    shadow: ti.template(),
    disc: ti.template(),
    x,
    y,
    z,
    normal,
    color,
    gloss,
):
    """Linear colour of a surface seen at column x, row y of the grid at depth z."""
    ray = ray_through(view, x, y)
    p, toward = row3(view, at.EYE) + ray * z, -ray.normalized()
    n = normal.normalized(1e-9)
    if n.dot(toward) < 0:
        n = -n
    sun = -row3(view, at.DEEP)
    facing, clear = ti.max(n.dot(sun), 0.0), 0.0
    if facing > 0:
        clear = visibility(view, shadow, p, n)
    air = openness(view, depth, disc, x, y, z, p, n)
    up = 0.5 + 0.5 * n.z
    ambient = (row3(view, at.SKY) * up + row3(view, at.BOUNCE) * (1 - up)) * air
    direct = row3(view, at.SUN) * (facing * clear * (0.6 + 0.4 * air))
    shine = ti.max(n.dot((sun + toward).normalized()), 0.0) ** 32
    return color * (ambient + direct) + row3(view, at.SUN) * (gloss * shine * clear)


@ti.func
def alike(depth: ti.template(), surface: ti.template(), label: ti.template(), y, x, v, u):
    """Whether two samples show the same smooth piece of surface."""
    same = label[y, x] == label[v, u]
    if same and label[y, x] != 0:
        bend = 0.0
        for k in ti.static(range(3)):
            bend += surface[y, x, k] * surface[v, u, k]
            if ti.abs(surface[y, x, 3 + k] - surface[v, u, 3 + k]) > 0.04:
                same = False
        if bend < 0.95 or ti.abs(depth[y, x] - depth[v, u]) > 0.02 * depth[y, x]:
            same = False
    return same


@ti.kernel
def shade_tiles(
    view: F1,
    tiles: I2,
    side: ti.i32,
    rate: ti.i32,
    depth: F2,
    surface: F3,
    label: I2,
    shadow: F2,
    disc: F2,
    gamma: U1,
    frame: U3,
    mask: U2,
):
    """Shade tiles marked 1 into `frame` [H, W, 3] and `mask` [H, W], of rate × rate samples each.

    Samples of a pixel that show the same surface are shaded once, at their mean, and weighed by
    their number; the mask takes the instance with the most samples.
    """
    ti.loop_config(serialize=True)
    for ty, tx in ti.ndrange(tiles.shape[0], tiles.shape[1]):
        if tiles[ty, tx] == 1:
            for row in range(ty * side // rate, ti.min((ty + 1) * side // rate, frame.shape[0])):
                for column in range(
                    tx * side // rate, ti.min((tx + 1) * side // rate, frame.shape[1])
                ):
                    total, done, most = Vec3(0.0), 0, 0
                    for s in range(rate * rate):
                        if (done >> s) & 1 == 0:
                            y, x = row * rate + s // rate, column * rate + s % rate
                            count, owned, z = 0.0, 0, 0.0
                            mean, normal, color = ti.math.vec2(0.0), Vec3(0.0), Vec3(0.0)
                            for q in range(s, rate * rate):
                                v, u = row * rate + q // rate, column * rate + q % rate
                                if label[v, u] % 256 == label[y, x] % 256:
                                    owned += 1
                                if (done >> q) & 1 == 0 and alike(
                                    depth, surface, label, y, x, v, u
                                ):
                                    done |= 1 << q
                                    count += 1
                                    mean += ti.math.vec2(u + 0.5, v + 0.5)
                                    z += depth[v, u]
                                    for k in ti.static(range(3)):
                                        normal[k] += surface[v, u, k]
                                        color[k] += surface[v, u, 3 + k]
                            if owned > most:
                                most = owned
                                mask[row, column] = ti.cast(label[y, x] % 256, ti.u8)
                            light = row3(view, at.BACKGROUND)
                            if label[y, x] != 0:
                                light = radiance(
                                    view, depth, shadow, disc, mean.x / count, mean.y / count,
                                    z / count, normal, color / count, surface[y, x, 6],
                                )  # fmt: skip
                            total += light * count
                    for k in ti.static(range(3)):
                        level = ti.math.clamp(total[k] / (rate * rate), 0.0, 1.0)
                        frame[row, column, k] = gamma[int(level * (gamma.shape[0] - 1))]
