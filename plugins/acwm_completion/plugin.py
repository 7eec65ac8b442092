"""Register completions, by the name of the argument that they complete."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_completions(registry: Registry) -> None:
    """Add completions."""
    for argument, function, what in (
        ("name", "components", "names of components"),
        ("environment", "environments", "names of environments"),
        ("recipe", "recipes", "recipes, and files"),
        ("file", "experiments", "experiments and recipes, and files"),
        ("overrides", "overrides", "keys of a recipe with their values, components, overlays"),
    ):
        registry.add(argument, f"acwm_completion.complete:{function}", summary=what)
