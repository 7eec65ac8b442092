"""What the states of push_sand and pour_water are, and how they are seen. Imports no simulator."""

from acwm_core.env.camera import Camera
from acwm_core.env.environment import StateField

GRAINS_RECORDED, WATER_RECORDED = 1000, 600
"""How many grains of sand and particles of water are recorded."""

HEIGHT_CELLS = (24, 40)
"""Rows and columns of push_sand's height map."""

SAND_CAMERA = Camera(eye=(0.0, -1.02, 0.86), target=(0.0, -0.045, 0.0), fov=38)
WATER_CAMERA = Camera(eye=(-0.2, -5.2, 2.35), target=(-0.2, 0.0, 0.95), fov=37)
"""The cameras of push_sand and pour_water with nominal factors."""

SUN = (0.5, -0.45, 1.1)
"""Direction to the sun of both with nominal factors."""

PUSH_SAND_STATE = (
    StateField(
        "grain_position",
        (GRAINS_RECORDED, 3),
        "m",
        f"centres of the first {GRAINS_RECORDED} grains (their order is random) in float16, z up",
    ),
    StateField("grain_count", (1,), "", "how many grains there are"),
    StateField("sand_center", (3,), "m", "mean position of all grains"),
    StateField(
        "sand_height",
        HEIGHT_CELLS,
        "m",
        "top of the sand over a grid on the table: rows from near to far (y), columns from left "
        "to right (x), in float16",
    ),
    StateField("board_position", (3,), "m", "centre of the board", "position", ("board",)),
    StateField(
        "board_quaternion",
        (4,),
        "",
        "orientation of the board (w, x, y, z)",
        "quaternion",
        ("board",),
        symmetry="box",
    ),
    StateField(
        "board_velocity",
        (3,),
        "m/s",
        "mean velocity of the board in the last frame",
        "vector",
        ("board",),
    ),
)

POUR_WATER_STATE = (
    StateField(
        "water_position",
        (WATER_RECORDED, 3),
        "m",
        f"centres of {WATER_RECORDED} particles of water (the same ones in all frames, chosen at "
        "random; from the first again if there are fewer) in float16, z up",
    ),
    StateField("water_count", (1,), "", "how many particles there are"),
    StateField(
        "water_share",
        (3,),
        "",
        "shares of the water in the cup, in the container, and spilled on the table; the rest is "
        "in the air",
    ),
    StateField("water_center", (3,), "m", "mean position of all water"),
    StateField("water_speed", (1,), "m/s", "root mean square speed of the water"),
    StateField(
        "cup_pose",
        (4,),
        "m, rad",
        "middle of the cup's inside, and its tilt towards +x",
        ("position", "position", "position", "angle"),
        ("cup",),
        axis=(0, 1, 0),
    ),
    StateField("cup_velocity", (4,), "m/s, rad/s", "of the same"),
    StateField("cup_target", (4,), "m, rad", "where the spring pulls the cup"),
    StateField(
        "container_position",
        (3,),
        "m",
        "middle of the foot of the container",
        "position",
        ("container",),
    ),
)
