"""Registers the recurrent dynamics model."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_models(registry: Registry) -> None:
    """Register the model. Its parameters set its size."""
    registry.add(
        "recurrent",
        "acwm_recurrent.recurrent:RecurrentModel",
        summary="1 M parameters: predicts the next latent frame at once, without noise",
    )
