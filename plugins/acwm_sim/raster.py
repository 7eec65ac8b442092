"""Geometry to samples: Taichi kernels that project, rasterise and cast shadows.

The arrays they share, for a grid of R rows and C columns of samples:

    view    [LENGTH]     see acwm_sim.view
    depth   [R, C]       distance along the line of sight in metres, FAR where empty
    surface [R, C, 7]    world normal (3), linear colour (3), gloss
    label   [R, C]       256 × part number + instance id, 0 where empty
    shadow  [S, S]       depth along the light in metres
    points  [V, 9]       a vertex: column, row, depth; world normal (3); shadow column, row, depth
    bounds  [N, 9]       a part: least and largest column, row, shadow column, shadow row; depth

Loops are serial and in index order, so equal inputs give equal bytes.
"""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportArgumentType=false
# pyright: reportOptionalOperand=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.engine import ti

FAR = 1e9

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
I2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
Vec3 = ti.math.vec3


@ti.func
def row3(view: ti.template(), start: ti.template()):
    """Three numbers of the view as a vector."""
    return Vec3(view[start], view[start + 1], view[start + 2])


@ti.func
def to_camera(view: ti.template(), world):
    """World point to camera coordinates (right, up, forward)."""
    p = world - row3(view, at.EYE)
    return Vec3(
        row3(view, at.ROTATION).dot(p),
        row3(view, at.ROTATION + 3).dot(p),
        row3(view, at.ROTATION + 6).dot(p),
    )


@ti.func
def to_world(view: ti.template(), camera):
    """Camera direction (right, up, forward) to world direction."""
    return (
        row3(view, at.ROTATION) * camera.x
        + row3(view, at.ROTATION + 3) * camera.y
        + row3(view, at.ROTATION + 6) * camera.z
    )


@ti.func
def to_light(view: ti.template(), world):
    """World point to shadow-map column and row (texels) and depth (metres)."""
    return Vec3(
        row3(view, at.ACROSS).dot(world) + view[at.ACROSS + 3],
        row3(view, at.ALONG).dot(world) + view[at.ALONG + 3],
        row3(view, at.DEEP).dot(world) + view[at.DEEP + 3],
    )


@ti.func
def widen(bounds: ti.template(), part, column, row, light, depth, reach, shade):
    """Grow a part's bounds by a disc: `reach` samples in the frame, `shade` texels in the map."""
    bounds[part, 0] = ti.min(bounds[part, 0], column - reach)
    bounds[part, 1] = ti.max(bounds[part, 1], column + reach)
    bounds[part, 2] = ti.min(bounds[part, 2], row - reach)
    bounds[part, 3] = ti.max(bounds[part, 3], row + reach)
    bounds[part, 4] = ti.min(bounds[part, 4], light.x - shade)
    bounds[part, 5] = ti.max(bounds[part, 5], light.x + shade)
    bounds[part, 6] = ti.min(bounds[part, 6], light.y - shade)
    bounds[part, 7] = ti.max(bounds[part, 7], light.y + shade)
    bounds[part, 8] = ti.min(bounds[part, 8], depth)


@ti.kernel
def project(
    view: F1, local: F2, owner: I1, position: F2, rotation: F3, parts: I2, points: F2, bounds: F2
):
    """Move vertices [V, 6] (point, normal) by their part's pose; project to frame and light.

    `parts` [N, 3]: instance id, solid (1: seen from outside only), visible. A rotation may carry
    a uniform scale.
    """
    ti.loop_config(serialize=True)
    for part in range(bounds.shape[0]):
        for k in range(9):
            bounds[part, k] = -FAR if k % 2 == 1 else FAR
    ti.loop_config(serialize=True)
    for v in range(local.shape[0]):
        part = owner[v]
        if parts[part, 2] == 1:
            world, normal = Vec3(0.0), Vec3(0.0)
            for i in ti.static(range(3)):
                world[i] = position[part, i]
                for j in ti.static(range(3)):
                    world[i] += rotation[part, i, j] * local[v, j]
                    normal[i] += rotation[part, i, j] * local[v, 3 + j]
            seen, light = to_camera(view, world), to_light(view, world)
            scale = view[at.FOCAL] / ti.max(seen.z, at.NEAR)
            column = view[at.CENTER_X] + scale * seen.x
            row = view[at.CENTER_Y] - scale * seen.y
            points[v, 0], points[v, 1], points[v, 2] = column, row, seen.z
            for i in ti.static(range(3)):
                points[v, 3 + i] = normal[i]
                points[v, 6 + i] = light[i]
            widen(bounds, part, column, row, light, seen.z, 1.0, 1.0)


@ti.func
def edges(ax, ay, bx, by, cx, cy, x, y):
    """Twice the signed areas that (x, y) makes with the sides of a triangle; their sum is 2A."""
    return Vec3(
        (bx - x) * (cy - y) - (by - y) * (cx - x),
        (cx - x) * (ay - y) - (cy - y) * (ax - x),
        (ax - x) * (by - y) - (ay - y) * (bx - x),
    )


@ti.func
def write(depth: ti.template(), surface: ti.template(), label: ti.template(), y, x, d, n, c, mark):
    """Store one visible sample; c is colour and gloss."""
    depth[y, x] = d
    label[y, x] = mark
    for k in ti.static(range(3)):
        surface[y, x, k] = n[k]
    for k in ti.static(range(4)):
        surface[y, x, 3 + k] = c[k]


@ti.kernel
def draw_triangles(
    points: F2,
    color: F2,
    triangles: I2,
    parts: I2,
    first: ti.i32,
    depth: F2,
    surface: F3,
    label: I2,
):
    """Rasterise triangles [F, 4] (three vertices, part); part numbers count from `first`."""
    ti.loop_config(serialize=True)
    for t in range(triangles.shape[0]):
        a, b, c, part = triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3]
        near = ti.min(points[a, 2], points[b, 2], points[c, 2])
        if parts[part, 2] == 1 and near > at.NEAR:
            ax, ay, bx, by = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
            cx, cy = points[c, 0], points[c, 1]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            # Rows grow downwards, so a triangle that faces the eye has negative area.
            if area < -1e-9 or (parts[part, 1] == 0 and area > 1e-9):
                x0 = ti.max(int(ti.floor(ti.min(ax, bx, cx))), 0)
                x1 = ti.min(int(ti.ceil(ti.max(ax, bx, cx))), depth.shape[1])
                y0 = ti.max(int(ti.floor(ti.min(ay, by, cy))), 0)
                y1 = ti.min(int(ti.ceil(ti.max(ay, by, cy))), depth.shape[0])
                mark = (first + part) * 256 + parts[part, 0]
                inverse = Vec3(1 / points[a, 2], 1 / points[b, 2], 1 / points[c, 2])
                for y in range(y0, y1):
                    for x in range(x0, x1):
                        flat = edges(ax, ay, bx, by, cx, cy, x + 0.5, y + 0.5) / area
                        if flat.min() >= 0:
                            d = 1 / flat.dot(inverse)
                            if d < depth[y, x]:
                                w = flat * inverse * d
                                n, s = Vec3(0.0), ti.math.vec4(0.0)
                                for k in ti.static(range(3)):
                                    n[k] = w.x * points[a, 3 + k] + w.y * points[b, 3 + k]
                                    n[k] += w.z * points[c, 3 + k]
                                for k in ti.static(range(4)):
                                    s[k] = w.x * color[a, k] + w.y * color[b, k] + w.z * color[c, k]
                                write(depth, surface, label, y, x, d, n.normalized(1e-9), s, mark)


@ti.kernel
def shade_triangles(points: F2, triangles: I2, parts: I2, shadow: F2):
    """Draw triangles into the shadow map."""
    ti.loop_config(serialize=True)
    for t in range(triangles.shape[0]):
        a, b, c, part = triangles[t, 0], triangles[t, 1], triangles[t, 2], triangles[t, 3]
        ax, ay, bx, by = points[a, 6], points[a, 7], points[b, 6], points[b, 7]
        cx, cy = points[c, 6], points[c, 7]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        # Of a solid, the side that faces the light is enough; its area is positive here.
        if parts[part, 2] == 1 and (area > 1e-9 or (parts[part, 1] == 0 and area < -1e-9)):
            x0 = ti.max(int(ti.floor(ti.min(ax, bx, cx))), 0)
            x1 = ti.min(int(ti.ceil(ti.max(ax, bx, cx))), shadow.shape[1])
            y0 = ti.max(int(ti.floor(ti.min(ay, by, cy))), 0)
            y1 = ti.min(int(ti.ceil(ti.max(ay, by, cy))), shadow.shape[0])
            for y in range(y0, y1):
                for x in range(x0, x1):
                    w = edges(ax, ay, bx, by, cx, cy, x + 0.5, y + 0.5) / area
                    if w.min() >= 0:
                        d = w.x * points[a, 8] + w.y * points[b, 8] + w.z * points[c, 8]
                        shadow[y, x] = ti.min(shadow[y, x], d)


@ti.kernel
def draw_spheres(
    view: F1,
    balls: F2,
    owner: I1,
    parts: I2,
    first: ti.i32,
    depth: F2,
    surface: F3,
    label: I2,
):
    """Ray-cast spheres [P, 8] (centre, radius, colour, gloss), exact at every sample."""
    ti.loop_config(serialize=True)
    for s in range(balls.shape[0]):
        part, r = owner[s], balls[s, 3]
        c = to_camera(view, Vec3(balls[s, 0], balls[s, 1], balls[s, 2]))
        if parts[part, 2] == 1 and c.z > r + at.NEAR:
            f, mx, my = view[at.FOCAL], view[at.CENTER_X], view[at.CENTER_Y]
            x0, x1 = silhouette(mx, f, c.x, c.z, r, depth.shape[1])
            y0, y1 = silhouette(my, f, -c.y, c.z, r, depth.shape[0])
            mark = (first + part) * 256 + parts[part, 0]
            paint = ti.math.vec4(balls[s, 4], balls[s, 5], balls[s, 6], balls[s, 7])
            for y in range(y0, y1):
                for x in range(x0, x1):
                    ray = Vec3((x + 0.5 - mx) / f, (my - y - 0.5) / f, 1.0)
                    along, length = ray.dot(c), ray.dot(ray)
                    inside = along * along - length * (c.dot(c) - r * r)
                    if inside > 0:
                        d = (along - ti.sqrt(inside)) / length
                        if d < depth[y, x]:
                            n = to_world(view, (ray * d - c) / r)
                            write(depth, surface, label, y, x, d, n, paint, mark)


@ti.func
def silhouette(middle, focal, offset, forward, r, limit):
    """First and past-the-last sample, along one axis, that a sphere's outline can reach."""
    # The outline is tangent to the planes through the eye at angle a ± b from the axis.
    span = ti.sqrt(ti.max(offset * offset + forward * forward - r * r, 1e-12))
    low = (offset * span - forward * r) / ti.max(forward * span + offset * r, 1e-6)
    high = (offset * span + forward * r) / ti.max(forward * span - offset * r, 1e-6)
    first = ti.floor(ti.math.clamp(middle + focal * low, 0.0, float(limit)))
    past = ti.ceil(ti.math.clamp(middle + focal * high, 0.0, float(limit)))
    return int(first), int(past)


@ti.kernel
def shade_spheres(view: F1, balls: F2, owner: I1, parts: I2, bounds: F2, shadow: F2):
    """Draw spheres into the shadow map, and grow their parts' bounds."""
    ti.loop_config(serialize=True)
    for s in range(balls.shape[0]):
        part, r = owner[s], balls[s, 3]
        if parts[part, 2] == 1:
            world = Vec3(balls[s, 0], balls[s, 1], balls[s, 2])
            light, seen = to_light(view, world), to_camera(view, world)
            size = r * view[at.TEXEL]
            scale = view[at.FOCAL] / ti.max(seen.z - r, at.NEAR)
            column = view[at.CENTER_X] + view[at.FOCAL] * seen.x / ti.max(seen.z, at.NEAR)
            row = view[at.CENTER_Y] - view[at.FOCAL] * seen.y / ti.max(seen.z, at.NEAR)
            widen(bounds, part, column, row, light, seen.z, 1.2 * scale * r + 1, size + 1)
            y0, y1 = (
                ti.max(int(light.y - size), 0),
                ti.min(int(light.y + size) + 1, shadow.shape[0]),
            )
            x0, x1 = (
                ti.max(int(light.x - size), 0),
                ti.min(int(light.x + size) + 1, shadow.shape[1]),
            )
            for y in range(y0, y1):
                for x in range(x0, x1):
                    q = size * size - (x + 0.5 - light.x) ** 2 - (y + 0.5 - light.y) ** 2
                    if q > 0:
                        d = light.z - ti.sqrt(q) / view[at.TEXEL]
                        shadow[y, x] = ti.min(shadow[y, x], d)
