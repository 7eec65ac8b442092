"""Register the environments of this package. Does not import a simulator."""

from acwm_core.plugins import Registry, hookimpl

_NEEDS = {"extra": "deformable", "requires": ("taichi",)}


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add cloth_move, its variant, and push_rope."""
    registry.add(
        "cloth_move",
        "acwm_deformable.cloth_move:ClothMove",
        physics="acwm_deformable.physics:CLOTH_MOVE",
        tasks={"edge": "acwm_deformable.cloth_task:EDGE"},
        summary="two grippers carry a cloth over a fixed sphere (Taichi XPBD)",
        **_NEEDS,
    )
    registry.add(
        "cloth_move_8d",
        "acwm_deformable.cloth_move:ClothMove8D",
        physics="acwm_deformable.physics:CLOTH_MOVE",
        summary="cloth_move with two arms that part, let go and take hold again (8-D action)",
        **_NEEDS,
    )
    registry.add(
        "push_rope",
        "acwm_deformable.push_rope:PushRope",
        physics="acwm_deformable.physics:PUSH_ROPE",
        tasks={"shape": "acwm_deformable.rope_task:SHAPE"},
        summary="an upright pole pushes a flexible rope about a table (Taichi XPBD)",
        **_NEEDS,
    )
