"""The layouts of all environments, by the name of the environment."""

from dataclasses import replace

from acwm_estimators.layout import Curve, Layout, Local, Points, Surface
from acwm_estimators.pinhole import Pinhole

CUBES = ("cube_1", "cube_2", "cube_3", "cube_4", "cube_5")
POSTS = ("obstacle_1", "obstacle_2", "obstacle_3", "obstacle_4")
HANDS = ("gripper_1", "gripper_2")

_PUSH_CUBE = Layout(
    Pinhole((0.0, 0.0, 1.25), (0.0, 0.0, 0.0), 30, up=(0.0, 1.0, 0.0)),
    ("wall", "pusher", *CUBES),
    (Points("pusher_position", ("pusher",), plane=0.05), Points("cube_position", CUBES)),
    (Local("cube_yaw", "cube_position", len(CUBES), "angle", fold=4, whole=True),),
)

_PUSHERS = ("pusher_1", "pusher_2")

_TWO_PUSHERS = replace(
    _PUSH_CUBE,
    instances=("wall", *_PUSHERS, *CUBES),
    points=(Points("pusher_position", _PUSHERS, plane=0.05), Points("cube_position", CUBES)),
)

_STACK_CUBE = Layout(
    Pinhole((1.10, -0.75, 0.85), (0.42, 0.0, 0.175), 34),
    ("arm", "gripper", "red_cube", "green_cube"),
    (
        Points("hand_position", ("gripper",)),
        Points("cube_position", ("red_cube", "green_cube")),
    ),
    (
        Local("gripper_opening", "hand_position", 1),
        Local("cube_quaternion", "cube_position", 2, "yaw", fold=4, whole=True),
    ),
)

_PUSH_ROPE = Layout(
    Pinhole((0.0, -2.2, 4.0), (0.0, -0.08, 0.0), 33.5),
    ("rope", "pole"),
    (Points("pole_position", ("pole",), plane=0.16),),
    curves=(Curve("rope_position", "rope_length", "rope", "pole", plane=0.035, end=0.035),),
)

_CLOTH_MOVE = Layout(
    Pinhole((0.0, -2.15, 1.55), (0.0, 0.0, 0.33), 39),
    ("sphere", "cloth", *HANDS),
    (Points("gripper_position", HANDS), Points("sphere_position", ("sphere",))),
)

_PUSH_SAND = Layout(
    Pinhole((0.0, -1.02, 0.86), (0.0, -0.045, 0.0), 38),
    ("sand", "board"),
    (Points("board_position", ("board",)),),
    (Local("board_quaternion", "board_position", 1, "axes", whole=True),),
    totals=("grain_count",),
    surface=Surface("sand_height", (24, 40), (0.48, 0.80), 0.03),
)

_POUR_WATER = Layout(
    Pinhole((-0.2, -5.2, 2.35), (-0.2, 0.0, 0.95), 37),
    ("cup", "container", "water", "holder"),
    (Points("cup_pose", ("cup",)), Points("container_position", ("container",))),
    (Local("cup_pose", "cup_pose", 1, "angle", column=3, whole=True),),
    totals=("water_cup", "water_container", "water_spilled", "water_air"),
)

_ROBOT_ARM = Layout(
    Pinhole((1.62, -1.02, 1.15), (0.24, -0.04, 0.37), 42),
    ("table", "arm", "gripper", *POSTS),
    (
        Points("link_position", ("arm",) * 7 + ("gripper",)),
        Points("hand_position", ("gripper",)),
        Points("obstacle_position", POSTS),
    ),
)

_REACHER = Layout(
    Pinhole((0.0, -1.5, 3.4), (0.0, -0.06, 0.0), 40.5),
    ("wall", "base", "upper_arm", "forearm", "fingertip", "goal"),
    (
        Points("elbow_position", ("forearm",), plane=0.198),
        Points("fingertip_position", ("forearm",), plane=0.198),
        Points("goal_position", ("goal",), plane=0.0),
    ),
)

LAYOUTS: dict[str, Layout] = {
    "push_cube": _PUSH_CUBE,
    "push_cube_4cube": _PUSH_CUBE,
    "push_cube_two_pushers": _TWO_PUSHERS,
    "stack_cube": _STACK_CUBE,
    "push_rope": _PUSH_ROPE,
    "cloth_move": _CLOTH_MOVE,
    "cloth_move_8d": _CLOTH_MOVE,
    "push_sand": _PUSH_SAND,
    "pour_water": _POUR_WATER,
    "robot_arm": _ROBOT_ARM,
    "reacher": _REACHER,
}

WEIGHTS: dict[str, str] = {name: name for name in LAYOUTS} | {
    "push_cube_4cube": "push_cube",
    "cloth_move_8d": "cloth_move",
}
"""Whose weights each environment is read with: variants that look alike share them."""
