"""Register the environments of this package. Does not import a simulator."""

from acwm_core.plugins import Registry, hookimpl
from acwm_sim.needs import BULLET


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add robot_arm and reacher."""
    registry.add(
        "robot_arm",
        "acwm_kinematics.robot_arm:RobotArm",
        physics="acwm_kinematics.physics:ROBOT_ARM",
        tasks={"reach": "acwm_kinematics.arm_task:REACH"},
        summary="a Franka Panda goes from goal to goal around posts by joint turns (PyBullet)",
        **BULLET,
    )
    registry.add(
        "reacher",
        "acwm_kinematics.reacher:ReacherArm",
        physics="acwm_kinematics.physics:REACHER",
        tasks={"reach": "acwm_kinematics.reacher_task:REACH"},
        extra="kinematics",
        requires=("mujoco", "taichi"),
        summary="a two-link arm brings its tip to a marker by joint torques (MuJoCo)",
    )
