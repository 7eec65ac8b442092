"""Registers the models that carry a scene or a grid, and the objective of scenes."""

from acwm_core.plugins import Registry, hookimpl

FORMER = {
    "planar_bodies": "PlanarBodies",
    "drawn_states": "DrawnStates",
    "flexible_body": "FlexibleBody",
}
"""Names of models in recipes of earlier versions, and the classes that read them."""


@hookimpl
def register_models(registry: Registry) -> None:
    """Register the models. Their parameters set their size."""
    registry.add(
        "scene",
        "acwm_scene.scene:SceneDynamics",
        summary="1 to 3 M parameters: reads, moves and draws what the environment's card declares",
        objective="scene",
    )
    for name, former in FORMER.items():
        registry.add(name, f"acwm_scene.former:{former}", summary="read in old runs: now `scene`")
    registry.add(
        "recurrent",
        "acwm_scene.recurrent:RecurrentModel",
        summary="1 M parameters: predicts the next latent frame at once, without noise",
        objective="regression",
        retired={"reading_blocks": 0, "patch_size": 1, "noise": 0},
    )


@hookimpl
def register_objectives(registry: Registry) -> None:
    """Register how scenes learn."""
    registry.add(
        "scene",
        "acwm_scene.objective:SceneObjective",
        summary="learns to read and draw from pictures, and motion from states and actions alone",
    )
