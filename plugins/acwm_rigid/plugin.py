"""Register the environments of this package. Does not import a simulator."""

from acwm_core.plugins import Registry, hookimpl
from acwm_sim.needs import BULLET

_NEEDS = {"extra": "rigid", "requires": ("mujoco", "taichi")}
_PUSHING = {
    "place": "acwm_rigid.push_task:PLACE",
    "place_and_turn": "acwm_rigid.push_task:PLACE_AND_TURN",
}


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add push_cube, its variants and stack_cube."""
    registry.add(
        "push_cube",
        "acwm_rigid.push_cube:PushCube",
        physics="acwm_rigid.physics:PUSH_CUBE",
        tasks=_PUSHING,
        summary="a round pusher and one to five coloured cubes on a walled table (MuJoCo)",
        **_NEEDS,
    )
    registry.add(
        "push_cube_4cube",
        "acwm_rigid.push_cube:PushCubeCrowded",
        physics="acwm_rigid.physics:PUSH_CUBE",
        tasks=_PUSHING,
        summary="push_cube, tested out of distribution on four and five cubes only",
        **_NEEDS,
    )
    registry.add(
        "push_cube_two_pushers",
        "acwm_rigid.push_cube:PushCubeTwoPushers",
        physics="acwm_rigid.physics:PUSH_CUBE_TWO_PUSHERS",
        tasks=_PUSHING,
        summary="push_cube with two pushers that move at once (4-D action)",
        **_NEEDS,
    )
    registry.add(
        "stack_cube",
        "acwm_rigid.stack_cube:StackCube",
        physics="acwm_rigid.physics:STACK_CUBE",
        tasks={"stack": "acwm_rigid.stack_task:STACK"},
        summary="a Franka Panda puts a red cube onto a green one (PyBullet)",
        **BULLET,
    )
