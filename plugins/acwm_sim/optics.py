"""What glass and water do to light: reflectance, length of path, and what they mirror."""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.arrays import Array, Vec2
from acwm_sim.engine import ti
from acwm_sim.raster import row3


@ti.func
def fresnel(cosine, head_on):
    """Share of light that a surface mirrors (Schlick 1994); `head_on` is that at cosine 1."""
    return ti.min(head_on + (1 - head_on) * (1 - ti.min(cosine, 1.0)) ** 5, 0.98)


@ti.func
def path(cosine):
    """How much longer the way through a sheet is than head-on."""
    return 1 / ti.max(cosine, 0.15)


@ti.func
def mirrored(view: Array, direction):
    """Linear colour of what a mirror shows in a direction: floor, sky, a light panel, the sun.

    The panel stands upright where the sun stands, as in a studio: upright walls of glass have
    something to mirror, too.
    """
    sun = -row3(view, at.DEEP)
    sky = ti.math.smoothstep(-0.15, 0.35, direction.z)
    light = 3 * row3(view, at.BOUNCE) * (1 - sky) + 0.9 * row3(view, at.BACKGROUND) * sky
    flat, flat_sun = Vec2(direction.x, direction.y), Vec2(sun.x, sun.y)
    beside = flat.dot(flat_sun) / ti.max(flat.norm() * flat_sun.norm(), 1e-6)
    tall = ti.math.smoothstep(-0.7, -0.4, direction.z) * ti.math.smoothstep(1.0, 0.85, direction.z)
    light += 1.6 * tall * ti.math.smoothstep(0.93, 0.985, beside) * row3(view, at.SUN)
    return light + 3.0 * ti.max(direction.dot(sun), 0.0) ** 40 * row3(view, at.SUN)
