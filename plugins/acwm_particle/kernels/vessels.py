"""Open round vessels as exact geometry: collisions with water, and the density that walls add.

Taichi functions for use inside a kernel. Vessels are bodies of revolution, so everything is
computed in the half plane of the distance to the axis (`rho`) and the height `z` above the inner
side of the floor.

    sizes   [V, 3]         per vessel: inner radius, thickness of wall and floor, inner height
    path    [S + 1, V, 5]  pose of each vessel after s substeps: centre of the inner side of its
                           floor (x, y, z), cosine and sine of its tilt about the y axis
"""

from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec2, Vec3, get3, set3


@ti.func
def to_vessel(path: Array, s, k, p):
    """Convert a world point to the frame of vessel k after s substeps."""
    d = p - Vec3(path[s, k, 0], path[s, k, 1], path[s, k, 2])
    c, n = path[s, k, 3], path[s, k, 4]
    return Vec3(c * d.x - n * d.z, d.y, n * d.x + c * d.z)


@ti.func
def turned(path: Array, s, k, d):
    """Convert a direction from the frame of vessel k to the world."""
    c, n = path[s, k, 3], path[s, k, 4]
    return Vec3(c * d.x + n * d.z, d.y, -n * d.x + c * d.z)


@ti.func
def from_vessel(path: Array, s, k, p):
    """Convert a point from the frame of vessel k to the world."""
    return turned(path, s, k, p) + Vec3(path[s, k, 0], path[s, k, 1], path[s, k, 2])


@ti.func
def rho_of(p):
    """Distance to the axis."""
    return ti.sqrt(p.x * p.x + p.y * p.y)


@ti.func
def is_within(sizes: Array, k, before, now):
    """Whether a particle that moved from `before` to `now` is on the inner side of vessel k.

    It changes sides only if its path passes over the rim.
    """
    middle = sizes[k, 0] + 0.5 * sizes[k, 1]
    a, b = rho_of(before), rho_of(now)
    was = a < middle and before.z > -0.5 * sizes[k, 1]
    now_in = b < middle and now.z > -0.5 * sizes[k, 1]
    if was != now_in:
        share = 0.5
        if (a < middle) != (b < middle):
            share = (middle - a) / (b - a)
        if before.z + share * (now.z - before.z) < sizes[k, 2]:
            now_in = was
    return now_in


@ti.func
def kept_in(rho, z, inner, thick, tall, radius):
    """(rho, z) of a particle on the inner side, moved out of wall, floor and rim."""
    floor = ti.max(z, radius)
    out = Vec2(rho, floor)
    if floor < tall:
        out.x = ti.min(rho, inner - radius)
    else:
        out = off_rim(out, inner, thick, tall, radius)
    return out


@ti.func
def kept_out(rho, z, inner, thick, tall, radius, before):
    """(rho, z) of a particle on the outer side, which was at height `before`."""
    out, outer = Vec2(rho, z), inner + thick
    if z >= tall:
        out = off_rim(out, inner, thick, tall, radius)
    elif z > -thick - radius and rho < outer + radius:
        if before < -0.5 * thick and rho < outer:
            out.y = -thick - radius
        elif z > -thick or rho > outer:
            corner = Vec2(outer, ti.max(z, -thick))
            gap = out - corner
            if z > -thick or gap.norm() < radius:
                out.x = outer + radius
    return out


@ti.func
def off_rim(p, inner, thick, tall, radius):
    """(rho, z) of a particle above the wall's upper end, moved out of its round edge."""
    edge = Vec2(inner + 0.5 * thick, tall)
    gap, reach = p - edge, 0.5 * thick + radius
    away = gap.norm()
    if away < reach:
        p = edge + gap * (reach / ti.max(away, 1e-9))
    return p


@ti.func
def share_beyond(u):
    """Share of the poly6 kernel beyond a plane at `u` kernel radii: the density added by a wall.

    The kernel integrated over the half space, 315/256 ∫ (1 - s²)⁴ ds from u to 1.
    """
    w = u * u
    return 0.5 - 1.23046875 * u * (1 + w * (-4 / 3 + w * (1.2 + w * (-4 / 7 + w / 9))))


@ti.func
def slope_beyond(u):
    """Rate at which the share of the spiky kernel beyond a plane falls with `u`."""
    v = (1 - u) * (1 - u)
    return 1.5 * v * v * (1 + 4 * u)


@ti.func
def push_off_walls(x: Array, last: Array, path: Array, sizes: Array, s, i, radius, hit: Array):
    """Move particle i out of walls and table on the shortest way; `hit` marks what it touched."""
    p = get3(x, i)
    for k in range(sizes.shape[0]):
        now = to_vessel(path, s + 1, k, p)
        inner, thick, tall = sizes[k, 0], sizes[k, 1], sizes[k, 2]
        rho, reach = rho_of(now), thick + radius
        # No particle moves by a wall's thickness and two radii in a substep, so a particle that
        # passes through a wall is found inside it.
        by_wall = rho > inner - radius or now.z < radius
        if by_wall and rho < inner + reach and now.z > -reach and now.z < tall + reach:
            before = to_vessel(path, s, k, get3(last, i))
            out = Vec2(rho, now.z)
            if is_within(sizes, k, before, now):
                out = kept_in(rho, now.z, inner, thick, tall, radius)
            else:
                out = kept_out(rho, now.z, inner, thick, tall, radius, before.z)
            if out.x != rho or out.y != now.z:
                hit[k] = 1
                wide = out.x / ti.max(rho, 1e-9)
                p = from_vessel(path, s + 1, k, Vec3(now.x * wide, now.y * wide, out.y))
    if p.z < radius:
        hit[sizes.shape[0]] = 1
        p.z = radius
    set3(x, i, p)


@ti.func
def fullness(p, path: Array, sizes: Array, s, h):
    """Density added by walls near a point, relative to rest, and its gradient."""
    share, gradient = 0.0, Vec3(0.0)
    for k in range(sizes.shape[0]):
        q = to_vessel(path, s + 1, k, p)
        rho, top = rho_of(q), sizes[k, 2] + 0.5 * h
        if rho < sizes[k, 0] and q.z > 0 and q.z < top:
            floor, side = ti.min(q.z / h, 1.0), ti.min((sizes[k, 0] - rho) / h, 1.0)
            if floor < 1 or side < 1:
                fade = ti.min(1.0, (top - q.z) / h)  # near the wall's upper end
                below, beside = share_beyond(floor), fade * share_beyond(side)
                share += below + beside - below * beside
                steep = fade * slope_beyond(side) * (1 - below) / (h * ti.max(rho, 1e-6))
                down = slope_beyond(floor) * (1 - beside) / h
                gradient += turned(path, s + 1, k, Vec3(q.x * steep, q.y * steep, -down))
    return share, gradient
