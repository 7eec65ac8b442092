"""Register the environments of this package. Does not import a simulator."""

from acwm_core.plugins import Registry, hookimpl

_NEEDS = {"extra": "particle", "requires": ("taichi",)}


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add push_sand and pour_water."""
    registry.add(
        "push_sand",
        "acwm_particle.push_sand:PushSand",
        physics="acwm_particle.physics:PUSH_SAND",
        tasks={"gather": "acwm_particle.sand_task:GATHER"},
        summary="a board pushes thousands of grains of sand about a table (PBD in Taichi)",
        **_NEEDS,
    )
    registry.add(
        "pour_water",
        "acwm_particle.pour_water:PourWater",
        physics="acwm_particle.physics:POUR_WATER",
        tasks={"fill": "acwm_particle.water_task:FILL"},
        summary="a held cup pours water into a container (PBF in Taichi)",
        **_NEEDS,
    )
