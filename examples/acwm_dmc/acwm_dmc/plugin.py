"""What this package registers with acwm."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add the environment."""
    registry.add(
        "dmc_cartpole",
        "acwm_dmc.cartpole:CartPole",
        summary="a cart that swings a pole (dm_control)",
    )
