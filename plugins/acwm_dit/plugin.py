"""Registers the sizes of the DiT, the conditioners, and the importer of published checkpoints."""

from acwm_core.plugins import Registry, hookimpl

SIZES = {
    "dit_xs": (128, 3, 2, "1.9 M parameters: trains on a CPU in minutes"),
    "dit_s": (768, 10, 12, "215 M parameters: the published DiT-S"),
    "dit_m": (1024, 16, 16, "608 M parameters: the published DiT-M"),
    "dit_l": (1024, 21, 16, "797 M parameters: the published DiT-L"),
    "dit_xl": (1152, 28, 16, "1343 M parameters: the large size of the published code"),
}
"""Width, layers, heads and summary of each size."""


@hookimpl
def register_models(registry: Registry) -> None:
    """Register the sizes: the same class with different presets."""
    for name, (width, layers, heads, summary) in SIZES.items():
        registry.add(
            name, "acwm_dit.dit:DiT", summary=summary, width=width, layers=layers, heads=heads
        )


@hookimpl
def register_conditioners(registry: Registry) -> None:
    """Register the two ways to condition on actions."""
    registry.add(
        "adaln",
        "acwm_dit.adaln:AdaLN",
        summary="adds the action embedding to the timestep embedding of each latent frame",
    )
    registry.add(
        "cross_attention",
        "acwm_dit.cross_attention:CrossAttention",
        summary="gated attention from the tokens of a frame to its action, after every layer",
    )
