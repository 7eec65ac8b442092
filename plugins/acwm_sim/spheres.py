"""Spheres as impostors: ray-cast where their outline falls, exact at every sample."""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.arrays import Array, Vec3, Vec4
from acwm_sim.engine import ti
from acwm_sim.raster import row3, span, to_camera, to_light, to_world, write


@ti.func
def draw_ball(view: Array, balls: Array, s, mark, depth: Array, surface: Array, label: Array):
    """Ray-cast one sphere, exact at every sample."""
    center = Vec3(balls[s, 0], balls[s, 1], balls[s, 2]) - row3(view, at.EYE)
    c, r, f = to_camera(view, center), balls[s, 3], view[at.FOCAL]
    if c.z > r + at.NEAR:
        mx, my = view[at.CENTER_X], view[at.CENTER_Y]
        x0, x1 = outline(mx, f, c.x, c.z, r, depth.shape[2])
        y0, y1 = outline(my, f, -c.y, c.z, r, depth.shape[1])
        paint = Vec4(balls[s, 4], balls[s, 5], balls[s, 6], balls[s, 7])
        for y in range(y0, y1):
            for x in range(x0, x1):
                if c.z - r < depth[0, y, x]:  # else it is hidden here for sure
                    ray = Vec3((x + 0.5 - mx) / f, (my - y - 0.5) / f, 1.0)
                    along, length = ray.dot(c), ray.dot(ray)
                    inside = along * along - length * (c.dot(c) - r * r)
                    if inside > 0:
                        d = (along - ti.sqrt(inside)) / length
                        if d < depth[0, y, x]:
                            normal = to_world(view, (ray * d - c) / r)
                            write(depth, surface, label, y, x, d, normal, paint, mark, s & 4095)


@ti.func
def outline(middle, focal, offset, forward, r, limit):
    """First and past-the-last cell, along one axis, that a sphere's outline can reach."""
    # The outline is tangent to two planes through the eye.
    reach = ti.sqrt(ti.max(offset * offset + forward * forward - r * r, 1e-12))
    low = (offset * reach - forward * r) / ti.max(forward * reach + offset * r, 1e-6)
    high = (offset * reach + forward * r) / ti.max(forward * reach - offset * r, 1e-6)
    return span(middle + focal * low, middle + focal * high, limit)


@ti.func
def cast_ball(view: Array, balls: Array, s, shadow: Array):
    """Draw one sphere into the shadow map."""
    light, r = to_light(view, Vec3(balls[s, 0], balls[s, 1], balls[s, 2])), balls[s, 3]
    size = r * view[at.TEXEL]
    x0, x1 = span(light.x - size, light.x + size, shadow.shape[2])
    y0, y1 = span(light.y - size, light.y + size, shadow.shape[1])
    for y in range(y0, y1):
        for x in range(x0, x1):
            q = size * size - (x + 0.5 - light.x) ** 2 - (y + 0.5 - light.y) ** 2
            if q > 0:
                d = light.z - ti.sqrt(q) / view[at.TEXEL]
                shadow[0, y, x] = ti.min(shadow[0, y, x], d)
