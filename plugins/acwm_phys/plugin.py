"""Registers the protocol of ACWM-Phys, which brings the tables of the paper."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_protocols(registry: Registry) -> None:
    """Add the published windows."""
    registry.add(
        "acwm-phys",
        "acwm_phys.protocol:PublishedWindows",
        summary="ten windows of 37 frames of each of 50 episodes, as published",
    )
