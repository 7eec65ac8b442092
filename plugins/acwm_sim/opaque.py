"""All opaque parts of a table, drawn into the samples and into the shadow map."""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim.arrays import Array
from acwm_sim.engine import ti
from acwm_sim.parts import BALL_0, BALL_1, INSTANCE, KIND, OPAQUE, SOLID, TRI_0, TRI_1, VISIBLE
from acwm_sim.raster import cast_triangle, corner, draw_triangle
from acwm_sim.spheres import cast_ball, draw_ball


@ti.func
def draw_parts(
    view: Array,
    table: Array,
    vertices: Array,
    triangles: Array,
    balls: Array,
    points: Array,
    first,
    depth: Array,
    surface: Array,
    label: Array,
):
    """Draw all visible opaque parts into the sample grid; labels count parts from `first`."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == OPAQUE:
            mark = (first + p) * 256 + table[p, INSTANCE]
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                draw_triangle(
                    vertices, points, i, j, k, table[p, SOLID], mark, depth, surface, label
                )
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                draw_ball(view, balls, s, mark, depth, surface, label)


@ti.func
def cast_parts(
    view: Array, table: Array, triangles: Array, balls: Array, points: Array, shadow: Array
):
    """Draw all visible opaque parts into the shadow map."""
    ti.loop_config(serialize=True)
    for p in range(table.shape[0]):
        if table[p, VISIBLE] == 1 and table[p, KIND] == OPAQUE:
            for t in range(table[p, TRI_0], table[p, TRI_1]):
                i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
                a, b, c = corner(points, i, 6), corner(points, j, 6), corner(points, k, 6)
                cast_triangle(a, b, c, table[p, SOLID], shadow)
            for s in range(table[p, BALL_0], table[p, BALL_1]):
                cast_ball(view, balls, s, shadow)
