"""What the states of push_rope and cloth_move are, and how they are seen. Imports no simulator."""

from acwm_core.env.camera import Camera
from acwm_core.env.environment import StateField

NODES = 80
"""Number of nodes of every rope, regardless of its length."""

CLOTH_NODES = 41
"""Number of nodes along each side of the cloth."""

NODE_STRIDE, VELOCITY_STRIDE = 2, 4
"""Every n-th is recorded, with its position and its velocity."""

ROPE_RADIUS = 0.035
"""Metres; the one for nominal factors."""

POLE_HALF = 0.16
"""Half the height of push_rope's pole, metres."""

ROPE_CAMERA = Camera(eye=(0.0, -2.2, 4.0), target=(0.0, -0.08, 0.0), fov=33.5)
CLOTH_CAMERA = Camera(eye=(0.0, -2.15, 1.55), target=(0.0, 0.0, 0.33), fov=39)
"""The cameras of push_rope and cloth_move with nominal factors."""

CLOTH_LIGHT = (0.4, -0.75, 1.15)
"""Direction to the sun of cloth_move with nominal factors."""

GRIPPERS = ("gripper_1", "gripper_2")

PUSH_ROPE_STATE = (
    StateField(
        "rope_position",
        (NODES, 2),
        "m",
        "nodes from end to end; x right, y away",
        "curve",
        ("rope",),
        height=ROPE_RADIUS,
    ),
    StateField("rope_velocity", (NODES, 2), "m/s", "velocity of every node", "vector", ("rope",)),
    StateField(
        "rope_length",
        (1,),
        "m",
        "sum of the distances between neighbouring nodes",
        follows=("rope_position",),
    ),
    StateField(
        "pole_position",
        (2,),
        "m",
        "middle of the pole; x right, y away",
        "position",
        ("pole",),
        height=POLE_HALF,
    ),
    StateField(
        "pole_velocity",
        (2,),
        "m/s",
        "mean velocity of the pole since the last frame",
        "vector",
        ("pole",),
    ),
)

_POINTS, _SPEEDS = (len(range(0, CLOTH_NODES, each)) for each in (NODE_STRIDE, VELOCITY_STRIDE))

CLOTH_MOVE_STATE = (
    StateField(
        "cloth_position",
        (_POINTS, _POINTS, 3),
        "m",
        f"every {NODE_STRIDE}nd node of the {CLOTH_NODES} × {CLOTH_NODES} along each side, "
        "float16, in the world (x right, y away, z up); the grippers first hold both ends of row 0",
        "surface",
        ("cloth",),
    ),
    StateField(
        "cloth_velocity",
        (_SPEEDS, _SPEEDS, 3),
        "m/s",
        f"every {VELOCITY_STRIDE}th node along each side, float16",
        "vector",
        ("cloth",),
    ),
    StateField("cloth_size", (), "m", "side of the cloth at rest"),
    StateField(
        "gripper_position", (2, 3), "m", "middle of each gripper's jaws", "position", GRIPPERS
    ),
    StateField("gripper_holds", (2,), "", "1 for a gripper that holds the cloth"),
    StateField("sphere_position", (3,), "m", "centre", "position", ("sphere",)),
    StateField("sphere_radius", (), "m", "it does not move"),
)
