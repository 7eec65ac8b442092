"""Registers the recurrent dynamics models, and the objective by which it learns to draw."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_models(registry: Registry) -> None:
    """Register the models. Their parameters set their size."""
    registry.add(
        "recurrent",
        "acwm_recurrent.recurrent:RecurrentModel",
        summary="1 M parameters: predicts the next latent frame at once, without noise",
        objective="regression",
    )
    registry.add(
        "planar_bodies",
        "acwm_recurrent.planar:PlanarBodies",
        summary="1 M parameters: moves the poses of bodies on a table, and draws them",
        objective="regression",
    )
    registry.add(
        "drawn_states",
        "acwm_recurrent.drawn:DrawnStates",
        summary="3 M parameters: moves the states of a robot and of what it holds, and draws them",
        objective="regression",
    )
    registry.add(
        "flexible_body",
        "acwm_recurrent.flexible:FlexibleBody",
        summary="1 M parameters: moves the nodes of a rope or a cloth, and draws them",
        objective="regression",
    )


@hookimpl
def register_objectives(registry: Registry) -> None:
    """Register the objective for models that draw a future."""
    registry.add(
        "energy_score",
        "acwm_recurrent.energy_score:EnergyScore",
        summary="two draws per clip, as near to the truth and as different as true futures",
    )
