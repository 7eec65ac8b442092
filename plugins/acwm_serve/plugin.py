"""Registers `acwm serve`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm serve`, after `acwm play`."""
    registry.add(
        "serve",
        "acwm_serve.commands:serve",
        summary="answer other programs: frames for actions, over a websocket",
        after="play",
        extra="serve",
        requires=("msgpack", "prometheus_client"),
    )
