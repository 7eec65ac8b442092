"""Types of kernel arguments (numpy arrays as Taichi sees them), and access to rows.

`F2` is a two-dimensional float32 array, `I1` a one-dimensional int32 array, `U3` a
three-dimensional uint8 array. `Array` is any of them as the argument of a Taichi function.
"""

from acwm_sim.engine import ti

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
F4 = ti.types.ndarray(dtype=ti.f32, ndim=4)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
I2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
I3 = ti.types.ndarray(dtype=ti.i32, ndim=3)
U1 = ti.types.ndarray(dtype=ti.u8, ndim=1)
U2 = ti.types.ndarray(dtype=ti.u8, ndim=2)
U3 = ti.types.ndarray(dtype=ti.u8, ndim=3)

Array = ti.template()
Vec2, Vec3, Vec4 = ti.math.vec2, ti.math.vec3, ti.math.vec4


@ti.func
def get3(x: Array, i):
    """Row i as a vector."""
    return Vec3(x[i, 0], x[i, 1], x[i, 2])


@ti.func
def set3(x: Array, i, value):
    """Write a vector to row i."""
    for k in ti.static(range(3)):
        x[i, k] = value[k]
