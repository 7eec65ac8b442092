"""Registers the recurrent dynamics model."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_models(registry: Registry) -> None:
    """Register the model. Its parameters set its size."""
    registry.add(
        "recurrent",
        "acwm_recurrent.recurrent:RecurrentModel",
        summary="1 M parameters: predicts the next latent frame at once, without noise",
        objective="regression",
    )
