"""What the states of push_cube and stack_cube are, and how they are seen. Imports no simulator."""

from acwm_core.env.camera import Camera
from acwm_core.env.environment import StateField

MAX_CUBES = 5

CUBES = tuple(f"cube_{k + 1}" for k in range(MAX_CUBES))
PAIR = ("red_cube", "green_cube")

TABLE_CAMERA = Camera(eye=(0, 0, 1.25), up=(0, 1, 0), fov=30)
"""The camera of push_cube."""

STACK_CAMERA = Camera(eye=(1.10, -0.75, 0.85), target=(0.42, 0.0, 0.175), fov=34)
"""The camera of stack_cube with nominal factors."""

STACK_LIGHT = (0.55, -0.35, 1.2)
"""Direction to the sun of stack_cube with nominal factors."""

PUSHER_HEIGHT = 0.05
"""Half the height of push_cube's pushers, metres."""


_THERE = "cube_present"

_CUBE_STATE = (
    StateField(
        "cube_present",
        (MAX_CUBES,),
        "",
        "1 for a cube that is there; others are zero",
        "presence",
        CUBES,
    ),
    StateField(
        "cube_position",
        (MAX_CUBES, 3),
        "m",
        "centre in the table's frame, z up",
        "position",
        CUBES,
        _THERE,
    ),
    StateField(
        "cube_quaternion",
        (MAX_CUBES, 4),
        "",
        "orientation (w, x, y, z)",
        "quaternion",
        CUBES,
        _THERE,
        symmetry="cube",
        follows=("cube_yaw",),
    ),
    StateField(
        "cube_yaw",
        (MAX_CUBES,),
        "rad",
        "heading around z, in [-π, π]",
        "angle",
        CUBES,
        _THERE,
        symmetry="quarter_turn",
        axis=(0, 0, 1),
    ),
    StateField(
        "cube_velocity", (MAX_CUBES, 3), "m/s", "velocity of the centre", "vector", CUBES, _THERE
    ),
    StateField(
        "cube_angular_velocity",
        (MAX_CUBES, 3),
        "rad/s",
        "in the table's frame",
        "value",
        CUBES,
        _THERE,
    ),
)


def push_cube_state(pushers: tuple[str, ...]) -> tuple[StateField, ...]:
    """The state of push_cube with pushers of these names."""
    return (
        StateField(
            "pusher_position",
            (len(pushers), 2),
            "m",
            "middle of each pusher on the table",
            "position",
            pushers,
            height=PUSHER_HEIGHT,
        ),
        StateField(
            "pusher_velocity",
            (len(pushers), 2),
            "m/s",
            "velocity of each pusher",
            "vector",
            pushers,
        ),
        *_CUBE_STATE,
    )


_FROM_JOINTS = ("joint_position",)

STACK_CUBE_STATE = (
    StateField("joint_position", (7,), "rad", "angles of the arm's joints"),
    StateField("joint_velocity", (7,), "rad/s", "of the arm's joints"),
    StateField(
        "hand_position",
        (3,),
        "m",
        "grasping point; the robot's base is the origin, z up",
        "position",
        ("gripper",),
        follows=_FROM_JOINTS,
    ),
    StateField(
        "hand_quaternion",
        (4,),
        "",
        "orientation of the hand (w, x, y, z)",
        "quaternion",
        ("gripper",),
        follows=_FROM_JOINTS,
    ),
    StateField("gripper_opening", (1,), "m", "distance between the fingertips"),
    StateField(
        "cube_position", (2, 3), "m", "centres of the red and the green cube", "position", PAIR
    ),
    StateField(
        "cube_quaternion",
        (2, 4),
        "",
        "orientations (w, x, y, z)",
        "quaternion",
        PAIR,
        symmetry="cube",
    ),
    StateField("cube_velocity", (2, 3), "m/s", "velocities of the centres", "vector", PAIR),
    StateField("cube_angular_velocity", (2, 3), "rad/s", "in the world's frame"),
    StateField("stacked", (1,), "", "1 when the red cube rests on the green one, released"),
)
