"""From geometry to samples: Taichi functions that project, rasterise and cast shadows.

The arrays they share, for a grid of R rows and C columns of samples. Where the first axis has two
layers, 0 is the current frame and 1 the static scene alone:

    view      [LENGTH]     see acwm_sim.view
    table     [N, 10]      one row per part, see acwm_sim.parts
    pose      [N, 12]      position in metres, then a rotation, which may include a uniform scale
    vertices  [V, 10]      point, normal, linear colour, gloss
    triangles [F, 3]       vertex numbers
    balls     [P, 8]       centre, radius, linear colour, gloss
    points    [V, 9]       column, row, depth; world normal; shadow column, row, depth
    bounds    [N, 9]       least and largest column, row, shadow column, shadow row; least depth
    depth     [2, R, C]    metres along the line of sight, FAR where empty
    surface   [2, R, C, 7] world normal, linear colour, gloss
    label     [2, R, C]    part, instance id and piece in one integer, 0 where empty; a piece is the
                           number of a sphere, or the quantised normal of a triangle
    shadow    [2, S, S]    depth along the light in metres; more layers if there is glass or fluid,
                           see acwm_sim.kernels.transparency

Spheres are impostors: they are ray-cast inside their outline, exactly at every sample. Loops run
serially in index order, so equal inputs give equal bytes.
"""

from acwm_sim import view as at
from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec3, Vec4
from acwm_sim.parts import BALL_0, BALL_1, VERT_0, VERT_1, VISIBLE

FAR = 1e9


@ti.func
def row3(view: Array, start: ti.template()):
    """Three consecutive numbers of the view as a vector."""
    return Vec3(view[start], view[start + 1], view[start + 2])


@ti.func
def to_camera(view: Array, direction):
    """Convert a world direction to a camera direction (right, up, forward)."""
    return Vec3(
        row3(view, at.ROTATION).dot(direction),
        row3(view, at.ROTATION + 3).dot(direction),
        row3(view, at.ROTATION + 6).dot(direction),
    )


@ti.func
def to_world(view: Array, direction):
    """Convert a camera direction (right, up, forward) to a world direction."""
    return (
        row3(view, at.ROTATION) * direction.x
        + row3(view, at.ROTATION + 3) * direction.y
        + row3(view, at.ROTATION + 6) * direction.z
    )


@ti.func
def to_light(view: Array, point):
    """Convert a world point to shadow-map column and row (texels) and depth (metres)."""
    return Vec3(
        row3(view, at.ACROSS).dot(point) + view[at.ACROSS + 3],
        row3(view, at.ALONG).dot(point) + view[at.ALONG + 3],
        row3(view, at.DEEP).dot(point) + view[at.DEEP + 3],
    )


@ti.func
def to_frame(view: Array, seen):
    """Convert a camera point to column and row of the sample grid, and depth."""
    scale = view[at.FOCAL] / ti.max(seen.z, at.NEAR)
    return Vec3(view[at.CENTER_X] + scale * seen.x, view[at.CENTER_Y] - scale * seen.y, seen.z)


@ti.func
def widen(bounds: Array, part, here, light, reach, shade):
    """Extend a part's bounds by a disc: `reach` samples in the frame, `shade` texels in the map."""
    for k in ti.static(range(2)):
        bounds[part, 2 * k] = ti.min(bounds[part, 2 * k], here[k] - reach)
        bounds[part, 2 * k + 1] = ti.max(bounds[part, 2 * k + 1], here[k] + reach)
        bounds[part, 4 + 2 * k] = ti.min(bounds[part, 4 + 2 * k], light[k] - shade)
        bounds[part, 5 + 2 * k] = ti.max(bounds[part, 5 + 2 * k], light[k] + shade)
    bounds[part, 8] = ti.min(bounds[part, 8], here.z)


@ti.func
def place_vertices(view: Array, pose: Array, vertices: Array, points: Array, bounds: Array, p, v):
    """Move vertex v of part p by its pose, and project it to the frame and to the light."""
    world, normal = Vec3(0.0), Vec3(0.0)
    for i in ti.static(range(3)):
        world[i] = pose[p, i]
        for j in ti.static(range(3)):
            world[i] += pose[p, 3 + 3 * i + j] * vertices[v, j]
            normal[i] += pose[p, 3 + 3 * i + j] * vertices[v, 3 + j]
    here = to_frame(view, to_camera(view, world - row3(view, at.EYE)))
    light = to_light(view, world)
    for i in ti.static(range(3)):
        points[v, i] = here[i]
        points[v, 3 + i] = normal[i]
        points[v, 6 + i] = light[i]
    widen(bounds, p, here, light, 1.0, 1.0)


@ti.func
def place_parts(
    view: Array,
    table: Array,
    pose: Array,
    vertices: Array,
    balls: Array,
    points: Array,
    bounds: Array,
):
    """Fill `points` and the `bounds` of every visible part."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        for k in range(9):
            bounds[p, k] = FAR * (-1.0 if k % 2 == 1 else 1.0)
        if table[p, VISIBLE] == 1:
            for v in range(table[p, VERT_0], table[p, VERT_1]):
                place_vertices(view, pose, vertices, points, bounds, p, v)
            for b in range(table[p, BALL_0], table[p, BALL_1]):
                center, r = Vec3(balls[b, 0], balls[b, 1], balls[b, 2]), balls[b, 3]
                here = to_frame(view, to_camera(view, center - row3(view, at.EYE)))
                reach = 1.3 * r * view[at.FOCAL] / ti.max(here.z - r, at.NEAR) + 1
                widen(bounds, p, here, to_light(view, center), reach, r * view[at.TEXEL] + 1)


@ti.func
def areas(a, b, c, x, y):
    """Twice the signed areas of (x, y) with each side of a triangle; they sum to the triangle's."""
    return Vec3(
        (b.x - x) * (c.y - y) - (b.y - y) * (c.x - x),
        (c.x - x) * (a.y - y) - (c.y - y) * (a.x - x),
        (a.x - x) * (b.y - y) - (a.y - y) * (b.x - x),
    )


@ti.func
def owns(p, q, share, area):
    """Whether a point is inside the side from p to q, or on it (share 0) and the triangle's own."""
    down, right = (q.y - p.y) * area, (q.x - p.x) * area
    return share > 0 or (share == 0 and (down > 0 or (down == 0 and right < 0)))


@ti.func
def covers(a, b, c, shares, area):
    """Whether a triangle covers a point; a point on a shared side belongs to one triangle only."""
    inside = shares.min() > 0
    if shares.min() == 0:
        inside = (
            owns(b, c, shares.x, area) and owns(c, a, shares.y, area) and owns(a, b, shares.z, area)
        )
    return inside


@ti.func
def row_span(a, b, c, area, y, x0, x1):
    """First and past-the-last cell of a row, from x0 to x1, that a triangle can cover."""
    first, last = x0, x1
    if x1 - x0 > 4:
        low, high, turn = float(x0), float(x1), 1.0 if area > 0 else -1.0
        start, grow = areas(a, b, c, 0.0, y) * turn, Vec3(b.y - c.y, c.y - a.y, a.y - b.y) * turn
        for k in ti.static(range(3)):
            edge = -start[k] / grow[k]
            if grow[k] > 1e-6:
                low = ti.max(low, edge - 1.5)
            elif grow[k] < -1e-6:
                high = ti.min(high, edge + 1.5)
        first, last = int(ti.min(low, high)), int(ti.ceil(high))
    return first, last


@ti.func
def span(low, high, limit):
    """First and past-the-last whole cell between two coordinates, inside [0, limit)."""
    first = int(ti.floor(ti.math.clamp(low, 0.0, float(limit))))
    return first, int(ti.ceil(ti.math.clamp(high, 0.0, float(limit))))


@ti.func
def corner(points: Array, vertex, start: ti.template()):
    """Three consecutive numbers of a projected vertex."""
    return Vec3(points[vertex, start], points[vertex, start + 1], points[vertex, start + 2])


@ti.func
def facing(normal):
    """Quantise a normal to four bits per axis, in one integer."""
    bits = 0
    for k in ti.static(range(3)):
        bits = bits * 16 + int((normal[k] + 1) * 7.99)
    return bits


@ti.func
def write(depth: Array, surface: Array, label: Array, y, x, d, normal, paint, mark, piece):
    """Store one visible sample; `paint` is colour and gloss, `mark` part and instance.

    `piece` has twelve bits: samples with equal mark and piece show the same smooth surface.
    """
    depth[0, y, x] = d
    for k in ti.static(range(3)):
        surface[0, y, x, k] = normal[k]
    for k in ti.static(range(4)):
        surface[0, y, x, 3 + k] = paint[k]
    label[0, y, x] = mark * 4096 + piece


@ti.func
def draw_triangle(
    vertices: Array, points: Array, i, j, k, solid, mark, depth: Array, surface: Array, label: Array
):
    """Rasterise one triangle with perspective-correct normals and colours."""
    a, b, c = corner(points, i, 0), corner(points, j, 0), corner(points, k, 0)
    area = areas(a, b, c, a.x, a.y).sum()
    # Rows increase downwards, so a triangle that faces the eye has negative area.
    if ti.min(a.z, b.z, c.z) > at.NEAR and (area < -1e-9 or (solid == 0 and area > 1e-9)):
        x0, x1 = span(ti.min(a.x, b.x, c.x), ti.max(a.x, b.x, c.x), depth.shape[2])
        y0, y1 = span(ti.min(a.y, b.y, c.y), ti.max(a.y, b.y, c.y), depth.shape[1])
        inverse = Vec3(1 / a.z, 1 / b.z, 1 / c.z)
        for y in range(y0, y1):
            first, last = row_span(a, b, c, area, y + 0.5, x0, x1)
            for x in range(first, last):
                flat = areas(a, b, c, x + 0.5, y + 0.5) / area
                if flat.min() >= 0:
                    d = 1 / flat.dot(inverse)
                    if d < depth[0, y, x]:
                        w = flat * inverse * d
                        paint = Vec4(0.0)
                        for q in ti.static(range(4)):
                            paint[q] = w.x * vertices[i, 6 + q] + w.y * vertices[j, 6 + q]
                            paint[q] += w.z * vertices[k, 6 + q]
                        normal = w.x * corner(points, i, 3) + w.y * corner(points, j, 3)
                        normal = (normal + w.z * corner(points, k, 3)).normalized(1e-9)
                        write(depth, surface, label, y, x, d, normal, paint, mark, facing(normal))


@ti.func
def cast_triangle(a, b, c, solid, shadow: Array):
    """Draw one triangle into the shadow map; corners are shadow column, row, depth."""
    area = areas(a, b, c, a.x, a.y).sum()
    # For a solid, the side facing the light is enough; its area is positive here.
    if area > 1e-9 or (solid == 0 and area < -1e-9):
        x0, x1 = span(ti.min(a.x, b.x, c.x), ti.max(a.x, b.x, c.x), shadow.shape[2])
        y0, y1 = span(ti.min(a.y, b.y, c.y), ti.max(a.y, b.y, c.y), shadow.shape[1])
        for y in range(y0, y1):
            first, last = row_span(a, b, c, area, y + 0.5, x0, x1)
            for x in range(first, last):
                w = areas(a, b, c, x + 0.5, y + 0.5) / area
                if w.min() >= 0:
                    d = w.x * a.z + w.y * b.z + w.z * c.z
                    shadow[0, y, x] = ti.min(shadow[0, y, x], d)


@ti.func
def draw_ball(view: Array, balls: Array, s, mark, depth: Array, surface: Array, label: Array):
    """Ray-cast one sphere exactly at every sample."""
    center = Vec3(balls[s, 0], balls[s, 1], balls[s, 2]) - row3(view, at.EYE)
    c, r, f = to_camera(view, center), balls[s, 3], view[at.FOCAL]
    if c.z > r + at.NEAR:
        mx, my = view[at.CENTER_X], view[at.CENTER_Y]
        x0, x1 = outline(mx, f, c.x, c.z, r, depth.shape[2])
        y0, y1 = outline(my, f, -c.y, c.z, r, depth.shape[1])
        paint = Vec4(balls[s, 4], balls[s, 5], balls[s, 6], balls[s, 7])
        for y in range(y0, y1):
            for x in range(x0, x1):
                if c.z - r < depth[0, y, x]:  # otherwise it is certainly hidden here
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
