"""Plugins as pip would install them, and what came of the others."""

from collections.abc import Callable

from acwm_core.plugins import Catalog

Install = Callable[..., None]


def loaded() -> Catalog:
    catalog = Catalog()
    catalog.load_entry_points()
    return catalog


def reasons(catalog: Catalog) -> dict[str, str]:
    return {problem.plugin: problem.reason for problem in catalog.problems}


REFERENCE = loaded()


def unharmed(catalog: Catalog) -> bool:
    """Whether every component that is there without the test's plugins is still there."""
    components = {
        (kind, component.name) for kind in catalog.kinds for component in catalog.registry(kind)
    }
    return components >= {
        (kind, component.name) for kind in REFERENCE.kinds for component in REFERENCE.registry(kind)
    }
