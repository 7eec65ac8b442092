"""How glass and fluid change light: reflectance, path length, mirror images and shadows.

If a scene has either, the shadow map [7, S, S] has more layers: 2 is the least depth along the
light of any glass or fluid, 3 the optical density of glass and 4 the metres of fluid on the path of
the light; 5 and 6 keep layers 2 and 3 of the static scene.
"""
# ruff: noqa: SIM102 (a nested "if" guards a read; "and" need not short-circuit here)

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec2, Vec3
from acwm_sim.kernels.raster import areas, corner, covers, row3, row_span, span, to_light
from acwm_sim.parts import BALL_0, BALL_1, FLUID, GLASS, KIND, TRI_0, TRI_1, VISIBLE


@ti.func
def fresnel(cosine, head_on):
    """Share of light that a surface reflects (Schlick 1994); `head_on` is the share at cosine 1."""
    return ti.min(head_on + (1 - head_on) * (1 - ti.min(cosine, 1.0)) ** 5, 0.98)


@ti.func
def path(cosine):
    """Length of the path through a sheet, relative to the path head-on."""
    return 1 / ti.max(cosine, 0.15)


@ti.func
def mirrored(view: Array, direction):
    """Linear colour that a mirror shows in a direction: floor, sky, a light panel and the sun.

    The panel stands upright in the direction of the sun, as in a photo studio, so that upright
    glass walls also have something to reflect.
    """
    sun = -row3(view, at.DEEP)
    sky = ti.math.smoothstep(-0.15, 0.35, direction.z)
    light = 3 * row3(view, at.BOUNCE) * (1 - sky) + 0.9 * row3(view, at.BACKGROUND) * sky
    flat, flat_sun = Vec2(direction.x, direction.y), Vec2(sun.x, sun.y)
    beside = flat.dot(flat_sun) / ti.max(flat.norm() * flat_sun.norm(), 1e-6)
    tall = ti.math.smoothstep(-0.7, -0.4, direction.z) * ti.math.smoothstep(1.0, 0.85, direction.z)
    light += 1.6 * tall * ti.math.smoothstep(0.93, 0.985, beside) * row3(view, at.SUN)
    return light + 3.0 * ti.max(direction.dot(sun), 0.0) ** 40 * row3(view, at.SUN)


LAYERS = 7

LEFT = 0.35
"""Share of the sunlight that passes a fluid of any thickness: light scattered on its way down."""


@ti.func
def cast_pane(view: Array, vertices: Array, points: Array, i, j, k, shadow: Array):
    """Add the optical density of a glass triangle, at the angle of the light, to the map."""
    a, b, c = corner(points, i, 6), corner(points, j, 6), corner(points, k, 6)
    area = areas(a, b, c, a.x, a.y).sum()
    if ti.abs(area) > 1e-9:
        x0, x1 = span(ti.min(a.x, b.x, c.x), ti.max(a.x, b.x, c.x), shadow.shape[2])
        y0, y1 = span(ti.min(a.y, b.y, c.y), ti.max(a.y, b.y, c.y), shadow.shape[1])
        n = (corner(points, i, 3) + corner(points, j, 3) + corner(points, k, 3)).normalized(1e-9)
        cosine = ti.abs(n.dot(row3(view, at.DEEP)))
        green = ti.max(vertices[i, 7], 1e-4)
        density = -ti.log(green) * path(cosine) - ti.log(1 - fresnel(cosine, 0.04))
        for y in range(y0, y1):
            first, last = row_span(a, b, c, area, y + 0.5, x0, x1)
            for x in range(first, last):
                w = areas(a, b, c, x + 0.5, y + 0.5) / area
                if covers(a, b, c, w, area):
                    d = w.x * a.z + w.y * b.z + w.z * c.z
                    shadow[2, y, x] = ti.min(shadow[2, y, x], d)
                    shadow[3, y, x] += density


@ti.func
def cast_drop(view: Array, balls: Array, s, shadow: Array):
    """Add the thickness in metres of one fluid particle to the map."""
    light = to_light(view, Vec3(balls[s, 0], balls[s, 1], balls[s, 2]))
    size = view[at.GRAIN] * view[at.TEXEL]
    x0, x1 = span(light.x - size, light.x + size, shadow.shape[2])
    y0, y1 = span(light.y - size, light.y + size, shadow.shape[1])
    for y in range(y0, y1):
        for x in range(x0, x1):
            q = size * size - (x + 0.5 - light.x) ** 2 - (y + 0.5 - light.y) ** 2
            if q > 0:
                half = ti.sqrt(q) / view[at.TEXEL]
                shadow[2, y, x] = ti.min(shadow[2, y, x], light.z - half)
                shadow[4, y, x] += 2 * half * at.SHARE


@ti.func
def cast_clear(
    view: Array,
    table: Array,
    vertices: Array,
    triangles: Array,
    balls: Array,
    points: Array,
    shadow: Array,
):
    """Draw all visible glass and fluid into the shadow map."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == GLASS:
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                cast_pane(view, vertices, points, i, j, k, shadow)
        if table[p, VISIBLE] == 1 and table[p, KIND] == FLUID:
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                cast_drop(view, balls, s, shadow)


@ti.func
def veil(view: Array, shadow: Array, p):
    """Share of sunlight that glass and fluid let through to a point, per colour, blurred."""
    light = to_light(view, p)
    left, spread = Vec3(0.0), view[at.BLUR] * (2.0 / 3.0)
    for q in range(9):
        x = int(ti.floor(light.x + (q % 3 - 1) * spread))
        y = int(ti.floor(light.y + (q // 3 - 1) * spread))
        through = Vec3(1.0)
        if x >= 0 and y >= 0 and x < shadow.shape[2] and y < shadow.shape[1]:
            if shadow[2, y, x] < light.z - view[at.BIAS]:
                thick = shadow[4, y, x]
                through = ti.exp(-(row3(view, at.ABSORB) + view[at.HAZE]) * thick)
                through = (LEFT + (1 - LEFT) * through) * ti.exp(-shadow[3, y, x])
        left += through
    return left / 9
