"""What the states of robot_arm and reacher are, and how they are seen. Imports no simulator."""

from acwm_core.env.camera import Camera
from acwm_core.env.environment import StateField

MAX_POSTS = 4
"""Most posts on robot_arm's table."""

GOALS = 3
"""How many goals robot_arm has."""

POST_NAMES = tuple(f"obstacle_{k + 1}" for k in range(MAX_POSTS))
GOAL_NAMES = tuple(f"goal_{k + 1}" for k in range(GOALS))

FOREARM_HEIGHT = 0.198
"""Height of the middle of reacher's forearm, metres."""

ARM_CAMERA = Camera(eye=(1.62, -1.02, 1.15), target=(0.24, -0.04, 0.37), fov=42)
REACHER_CAMERA = Camera(eye=(0.0, -1.5, 3.4), target=(0.0, -0.06, 0.0), fov=40.5)
"""The cameras of robot_arm and reacher with nominal factors."""

ARM_LIGHT = (0.45, -0.55, 1.2)
"""Direction to the sun of robot_arm with nominal factors."""

_FROM_JOINTS = ("joint_position",)
_FROM_ANGLES = ("joint_angle",)

ROBOT_ARM_STATE = (
    StateField("joint_position", (7,), "rad", "angles of the arm's joints"),
    StateField("joint_velocity", (7,), "rad/s", "of the arm's joints"),
    StateField("joint_target", (7,), "rad", "angles that the servos are told to hold"),
    StateField(
        "link_position",
        (8, 3),
        "m",
        "origins of the frames of links 1 to 7 and the hand",
        "position",
        ("arm",) * 7 + ("gripper",),
        follows=_FROM_JOINTS,
    ),
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
    StateField(
        "hand_velocity",
        (3,),
        "m/s",
        "velocity of the grasping point",
        "vector",
        ("gripper",),
        follows=("joint_position", "joint_velocity"),
    ),
    StateField(
        "goal_position",
        (GOALS, 3),
        "m",
        "goals, in the order of the behaviour's tour",
        "position",
        GOAL_NAMES,
    ),
    StateField("goal_reached", (GOALS,), "", "1 once the grasping point has been at the goal"),
    StateField(
        "obstacle_present",
        (MAX_POSTS,),
        "",
        "1 for a post that is there; others are zero",
        "presence",
        POST_NAMES,
    ),
    StateField(
        "obstacle_position",
        (MAX_POSTS, 3),
        "m",
        "centre of a post",
        "position",
        POST_NAMES,
        "obstacle_present",
    ),
    StateField(
        "obstacle_size",
        (MAX_POSTS, 2),
        "m",
        "radius (or half width) and height of a post",
        "value",
        POST_NAMES,
        "obstacle_present",
    ),
)

REACHER_STATE = (
    StateField(
        "joint_angle",
        (2,),
        "rad",
        "shoulder from +x, elbow from the upper arm; [-π, π]",
        "angle",
        ("upper_arm", "forearm"),
    ),
    StateField("joint_velocity", (2,), "rad/s", "shoulder and elbow"),
    StateField(
        "elbow_position",
        (2,),
        "m",
        "from the shoulder, x right and y away",
        "position",
        ("upper_arm",),
        height=FOREARM_HEIGHT,
        follows=_FROM_ANGLES,
    ),
    StateField(
        "fingertip_position",
        (2,),
        "m",
        "from the shoulder, x right and y away",
        "position",
        ("forearm",),
        height=FOREARM_HEIGHT,
        follows=_FROM_ANGLES,
    ),
    StateField(
        "fingertip_velocity",
        (2,),
        "m/s",
        "velocity of the fingertip",
        "vector",
        ("fingertip",),
        follows=("joint_angle", "joint_velocity"),
    ),
    StateField(
        "goal_position",
        (2,),
        "m",
        "middle of the marker, from the shoulder",
        "position",
        ("goal",),
    ),
)
