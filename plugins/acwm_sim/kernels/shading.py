"""From samples to pixels: Taichi functions for light, shadow, ambient occlusion, anti-aliasing.

Arrays are those of `raster`; `frame` is [H, W, 3] and `mask` [H, W], with `rate` × `rate`
samples in each pixel.
"""
# ruff: noqa: SIM102 (a nested "if" guards a read; "and" need not short-circuit here)

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec2, Vec3
from acwm_sim.kernels.raster import (
    FAR,
    row3,
    to_camera,
    to_light,
    to_world,
)
from acwm_sim.kernels.tiles import AO_DEPTH, ray_through
from acwm_sim.kernels.transparency import LAYERS, veil


@ti.func
def blocked(shadow: Array, x, y, z):
    """1 if the shadow map has something in front of depth z in a texel, else 0."""
    block = 0.0
    if x >= 0 and y >= 0 and x < shadow.shape[2] and y < shadow.shape[1]:
        if shadow[0, y, x] < z:
            block = 1.0
    return block


@ti.func
def visibility(view: Array, shadow: Array, p, n, exact):
    """Share of the sunlight that reaches a point, from 0 to 1: the mean over a blurred square.

    With `exact` it is computed exactly, otherwise estimated from the middle and the corners.
    """
    blur = view[at.BLUR]
    light = to_light(view, p + n * (0.5 / view[at.TEXEL]))
    z = light.z - view[at.BIAS]
    # Follow the slope of the receiver's own plane, or with a wide blur it would shadow itself.
    deep = ti.min(row3(view, at.DEEP).dot(n), -0.1) * view[at.TEXEL] ** 2
    tilt = Vec2(row3(view, at.ACROSS).dot(n), row3(view, at.ALONG).dot(n)) / -deep
    x0, x1 = int(ti.floor(light.x - blur)), int(ti.floor(light.x + blur))
    y0, y1 = int(ti.floor(light.y - blur)), int(ti.floor(light.y + blur))
    corners = blocked(shadow, int(ti.floor(light.x)), int(ti.floor(light.y)), z)
    for k in ti.static(range(4)):
        x, y = (x0, x1)[k % 2], (y0, y1)[k // 2]
        corners += blocked(shadow, x, y, z + tilt.dot(Vec2(x + 0.5, y + 0.5) - light.xy))
    dark = corners / 5
    if exact and corners > 0 and corners < 5:  # at the edge of a shadow
        dark = 0.0
        for y in range(y0, y1 + 1):
            high = ti.min(light.y + blur, y + 1.0) - ti.max(light.y - blur, float(y))
            for x in range(x0, x1 + 1):
                wide = ti.min(light.x + blur, x + 1.0) - ti.max(light.x - blur, float(x))
                slope = tilt.dot(Vec2(x + 0.5, y + 0.5) - light.xy)
                dark += blocked(shadow, x, y, z + slope) * wide * high
        dark /= 4 * blur * blur
    return 1 - dark


@ti.func
def openness(view: Array, depth: Array, x, y, z, n, step):
    """Share of the sky that nearby surfaces leave open, estimated from the depth of the samples.

    Works in camera coordinates, for the surface at column x, row y, depth z with normal n. Reads
    every `step`-th point of the disc. Points near its rim count less, and so do surfaces far behind
    or in front, so that the occlusion changes smoothly.
    """
    reach, p = view[at.AO_RADIUS], ray_through(view, x, y) * z
    spread, hidden = reach * view[at.FOCAL] / z, 0.0
    for tap in range(at.TAPS // step):
        k = tap * step + step // 2
        i = int(ti.floor(x + view[at.DISC + 2 * k] * spread))
        j = int(ti.floor(y + view[at.DISC + 2 * k + 1] * spread))
        if i >= 0 and j >= 0 and i < depth.shape[2] and j < depth.shape[1]:
            to = ray_through(view, i + 0.5, j + 0.5) * depth[0, j, i] - p
            above = n.dot(to)
            if above > 1e-5 and depth[0, j, i] < FAR:
                far = to.norm() + 1e-6
                weight = 2 * (1 - (k + 0.5) / at.TAPS)
                weight *= ti.max(0.0, 1 - (far / (AO_DEPTH * reach)) ** 2)
                hidden += ti.max(0.0, above / far - 0.08) * weight
    return ti.max(0.0, 1 - 1.2 * hidden / (at.TAPS // step))


@ti.func
def radiance(view: Array, depth: Array, shadow: Array, x, y, z, normal, color, gloss, step):
    """Linear colour of a surface seen at column x, row y of the grid at depth z.

    Surfaces that fill only one `step`-th of a pixel get correspondingly less work.
    """
    ray = to_world(view, ray_through(view, x, y))
    p, toward = row3(view, at.EYE) + ray * z, -ray.normalized()
    n = normal.normalized(1e-9)
    if n.dot(toward) < 0:
        n = -n
    sun = -row3(view, at.DEEP)
    facing, clear = ti.max(n.dot(sun), 0.0), 0.0
    if facing > 0:
        clear = visibility(view, shadow, p, n, step == 1)
    air = openness(view, depth, x, y, z, to_camera(view, n), step)
    up = 0.5 + 0.5 * n.z
    ambient = (row3(view, at.SKY) * up + row3(view, at.BOUNCE) * (1 - up)) * air
    rays = row3(view, at.SUN) * clear
    if clear > 0 and shadow.shape[0] == LAYERS:
        rays *= veil(view, shadow, p)
    shine = gloss * ti.max(n.dot((sun + toward).normalized()), 0.0) ** 32
    return color * (ambient + rays * (facing * (0.6 + 0.4 * air))) + rays * shine


@ti.func
def instance(label):
    """The instance id stored in a label."""
    return (label >> 12) & 255


@ti.func
def shade_group(
    view: Array,
    depth: Array,
    surface: Array,
    label: Array,
    shadow: Array,
    row,
    column,
    rate,
    s,
    done,
):
    """Shade all samples of a pixel that show the same smooth surface as sample s, at their mean.

    Returns:
        Their light times their number, `done` with their bits set, and the number of samples (from
        s on) that belong to the instance of s.
    """
    y, x = row * rate + s // rate, column * rate + s % rate
    mark, deep = label[0, y, x], depth[0, y, x]
    count, z, owned = 0.0, 0.0, 0
    middle, normal, color = Vec2(0.0), Vec3(0.0), Vec3(0.0)
    for q in range(s, rate * rate):
        v, u = row * rate + q // rate, column * rate + q % rate
        if instance(label[0, v, u]) == instance(mark):
            owned += 1
        near = ti.abs(depth[0, v, u] - deep) <= 0.02 * deep
        if near and label[0, v, u] == mark and (done >> q) & 1 == 0:
            done |= 1 << q
            count += 1
            middle += Vec2(u + 0.5, v + 0.5)
            z += depth[0, v, u]
            for k in ti.static(range(3)):
                normal[k] += surface[0, v, u, k]
                color[k] += surface[0, v, u, 3 + k]
    light = row3(view, at.BACKGROUND)
    if mark != 0:
        middle /= count
        gloss = surface[0, y, x, 6]
        step = ti.math.clamp(int(rate * rate / (2 * count)), 1, at.TAPS)
        light = radiance(
            view, depth, shadow, middle.x, middle.y, z / count, normal, color / count, gloss, step
        )
    return light * count, done, owned


@ti.func
def shade_pixel(
    view: Array,
    depth: Array,
    surface: Array,
    label: Array,
    shadow: Array,
    gamma: Array,
    rate,
    row,
    column,
    base: Array,
    frame: Array,
    mask: Array,
):
    """Average the samples of a pixel; the mask takes the instance with the most samples."""
    total, done, most = Vec3(0.0), 0, 0
    for s in range(rate * rate):
        if (done >> s) & 1 == 0:
            light, now_done, owned = shade_group(
                view, depth, surface, label, shadow, row, column, rate, s, done
            )
            total, done = total + light, now_done
            if owned > most:
                most = owned
                y, x = row * rate + s // rate, column * rate + s % rate
                mask[row, column] = ti.cast(instance(label[0, y, x]), ti.u8)
    for k in ti.static(range(3)):
        light = total[k] / (rate * rate)
        if base.shape[0] == 2:  # glass or fluid may be seen in front of this pixel
            base[0, row, column, k] = light
        level = ti.math.clamp(light, 0.0, 1.0)
        frame[row, column, k] = gamma[int(level * (gamma.shape[0] - 1))]


@ti.func
def shade_tile(
    view: Array,
    depth: Array,
    surface: Array,
    label: Array,
    shadow: Array,
    gamma: Array,
    pixels,
    rate,
    ty,
    tx,
    base: Array,
    frame: Array,
    mask: Array,
):
    """Shade all of a tile, `pixels` wide."""
    for row in range(ty * pixels, ti.min((ty + 1) * pixels, frame.shape[0])):
        for column in range(tx * pixels, ti.min((tx + 1) * pixels, frame.shape[1])):
            shade_pixel(
                view, depth, surface, label, shadow, gamma, rate, row, column, base, frame, mask
            )


@ti.func
def restore_base(pixels, ty, tx, lay, base: Array, bare: Array, mask: Array):
    """Restore the static scene's light in a tile, and with `lay` also the mask without glass."""
    for row in range(ty * pixels, ti.min((ty + 1) * pixels, base.shape[1])):
        for column in range(tx * pixels, ti.min((tx + 1) * pixels, base.shape[2])):
            for k in ti.static(range(3)):
                base[0, row, column, k] = base[1, row, column, k]
            if lay:
                mask[row, column] = bare[row, column]
