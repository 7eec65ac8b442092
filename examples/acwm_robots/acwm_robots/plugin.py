"""What this package registers with acwm."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add the environments."""
    for name, place, summary in (
        ("so101_cube", "so101:SO101Cube", "a SO-101 arm beside a cube (so101-nexus)"),
        ("ogbench_cube", "ogbench_cube:OGBenchCube", "a UR5e arm beside a cube (ogbench)"),
    ):
        registry.add(name, f"acwm_robots.{place}", summary=summary)
