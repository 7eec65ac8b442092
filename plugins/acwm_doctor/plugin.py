"""Registers the commands that say what is installed and whether it works."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm list`, `acwm show`, `acwm check` and `acwm doctor`."""
    registry.add(
        "list",
        "acwm_doctor.components:list_components",
        summary="list the installed components, or the recipes",
        after="acwm",
    )
    registry.add(
        "show", "acwm_doctor.components:show", summary="print a recipe in full", after="list"
    )
    registry.add(
        "check",
        "acwm_doctor.components:check",
        summary="run the conformance suite on a component",
        after="experiment",
    )
    registry.add(
        "doctor", "acwm_doctor.commands:doctor", summary="say what works here", after="check"
    )
