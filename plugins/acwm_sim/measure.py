"""The kernel that measures the static scene, once, for `acwm_sim.tiles`."""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_sim import view as at
from acwm_sim.arrays import F1, F3, F4, Array, Vec3
from acwm_sim.engine import ti
from acwm_sim.raster import FAR, row3, to_camera, to_light, to_world
from acwm_sim.shading import openness
from acwm_sim.tiles import ray_through


@ti.func
def is_occluded(view: Array, depth: Array, surface: Array, y, x):
    """Whether a sample has less than all of the sky."""
    ray = to_world(view, ray_through(view, x + 0.5, y + 0.5))
    n = Vec3(surface[0, y, x, 0], surface[0, y, x, 1], surface[0, y, x, 2])
    if n.dot(ray) > 0:
        n = -n
    return openness(view, depth, x + 0.5, y + 0.5, depth[0, y, x], to_camera(view, n), 1) < 1


@ti.kernel
def measure_tiles(view: F1, depth: F3, surface: F4, side: ti.i32, still: F3):
    """Fill `still`; layer 0 of `depth` and `surface` must be the static scene."""
    ti.loop_config(serialize=True)
    for ty in range(still.shape[0]):
        for tx in range(still.shape[1]):
            low, high, occluded = Vec3(FAR), Vec3(-FAR), 0
            near, far = FAR, -FAR
            for y in range(ty * side, ti.min((ty + 1) * side, depth.shape[1])):
                for x in range(tx * side, ti.min((tx + 1) * side, depth.shape[2])):
                    if depth[0, y, x] < FAR:
                        ray = to_world(view, ray_through(view, x + 0.5, y + 0.5))
                        p = to_light(view, row3(view, at.EYE) + ray * depth[0, y, x])
                        low, high = ti.min(low, p), ti.max(high, p)
                        near, far = ti.min(near, depth[0, y, x]), ti.max(far, depth[0, y, x])
                        occluded |= is_occluded(view, depth, surface, y, x)
            for k in ti.static(range(2)):
                still[ty, tx, 2 * k] = low[k]
                still[ty, tx, 2 * k + 1] = high[k]
            still[ty, tx, 4] = near
            still[ty, tx, 5] = far
            still[ty, tx, 6] = occluded
