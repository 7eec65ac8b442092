"""Register the protocol and the tables of ACWM-Phys."""

from acwm_core.plugins import Registry, hookimpl

TABLES = {
    "main": "ACWM-DiT-S on all environments",
    "conditioning": "adaln and cross_attention",
    "scale": "sizes of the model",
    "codec": "WanVAE and FLUX VAE",
    "data": "shares of the training data",
    "actions": "numbers of action dimensions",
}
"""Subjects of the tables, by name."""


@hookimpl
def register_protocols(registry: Registry) -> None:
    """Add the published windows."""
    registry.add(
        "acwm-phys",
        "acwm_phys.protocol:PublishedWindows",
        summary="ten windows of 37 frames of each of 50 episodes, as published",
    )


@hookimpl
def register_tables(registry: Registry) -> None:
    """Add the published tables."""
    for name, summary in TABLES.items():
        registry.add(name, "acwm_phys.tables:published_table", summary=summary, table=name)
