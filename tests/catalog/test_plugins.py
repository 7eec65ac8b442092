"""A broken plugin is left out and reported; every other one works on."""

from pathlib import Path

import pytest

from acwm_core.errors import MissingExtraError, PluginError, RecipeError, suggest
from acwm_core.plugins import Catalog, Registry, hookimpl
from tests.catalog.installing import REFERENCE, Install, loaded, reasons, unharmed
from tests.plugins import plugin_of


def test_the_builtin_plugins_load() -> None:
    assert REFERENCE.problems == []
    assert {"acwm_rigid", "acwm_codecs", "acwm_dit", "acwm_metrics"} <= {*REFERENCE.plugins}


def test_a_plugin_of_ones_own(install: Install) -> None:
    install(
        "plugin_fine",
        """
        class Codec:
            def __init__(self, width=1, depth=1): self.size = (width, depth)

        @hookimpl
        def register_codecs(registry):
            registry.add("sound", "plugin_fine:Codec", summary="a codec", width=3)
        """,
    )
    catalog = loaded()
    component = catalog.component("codec", "sound")
    assert (component.plugin, component.distribution) == ("plugin_fine", "plugin_fine")
    assert catalog.create("codec", "sound", depth=2).size == (3, 2)


def test_one_that_registers_a_taken_name(install: Install) -> None:
    install(
        "plugin_takes",
        """
        @hookimpl
        def register_models(registry):
            registry.add("of_its_own", "plugin_takes:Model")

        @hookimpl
        def register_codecs(registry):
            registry.add("compact", "plugin_takes:Codec")
        """,
    )
    catalog = loaded()
    assert "already registered by plugin 'acwm_codecs'" in reasons(catalog)["plugin_takes"]
    assert catalog.component("codec", "compact").plugin == "acwm_codecs"
    assert "of_its_own" not in catalog.registry("model")  # all it had added was taken back
    assert "plugin_takes" not in catalog.plugins
    assert unharmed(catalog)


def test_one_with_a_misspelt_hook(install: Install) -> None:
    install(
        "plugin_misspelt",
        """
        @hookimpl
        def register_codec(registry):
            registry.add("never", "plugin_misspelt:Codec")
        """,
    )
    catalog = loaded()
    assert "register_codec" in reasons(catalog)["plugin_misspelt"]
    assert unharmed(catalog)


def test_one_whose_extra_is_missing(install: Install, tmp_path: Path) -> None:
    install(
        "plugin_extra",
        """
        @hookimpl
        def register_environments(registry):
            registry.add(
                "needy", "plugin_extra_heavy:Needy", extra="sim", requires=("no_such_engine.core",)
            )
        """,
    )
    (tmp_path / "plugin_extra_heavy.py").write_text("import no_such_engine.core\n")
    catalog = loaded()
    assert catalog.problems == []
    component = catalog.component("environment", "needy")
    assert component.missing_modules() == ["no_such_engine.core"]
    needs = r"environment 'needy' needs 'no_such_engine': pip install 'plugin_extra\[sim\]'"
    with pytest.raises(MissingExtraError, match=needs):
        component.load()


def test_one_whose_extra_cannot_install_what_it_needs(install: Install) -> None:
    install(
        "plugin_extra",
        """
        @hookimpl
        def register_environments(registry):
            needs = {"extra": "sim", "requires": ("no_such_engine",), "install": "build an engine"}
            registry.add("needy", "plugin_extra_heavy:Needy", **needs)
        """,
    )
    assert loaded().component("environment", "needy").needs == (
        "needs no_such_engine: build an engine"
    )


def test_a_missing_module_of_its_own_is_told(install: Install) -> None:
    install(
        "plugin_bug",
        """
        @hookimpl
        def register_codecs(registry):
            registry.add("bug", "plugin_bug.nowhere:Codec")
            registry.add("bugger", "plugin_bug:Nothing")
        """,
    )
    catalog = loaded()
    with pytest.raises(ModuleNotFoundError, match="in codec 'bug' of plugin 'plugin_bug'"):
        catalog.component("codec", "bug").load()
    with pytest.raises(PluginError, match="plugin_bug has no 'Nothing'"):
        catalog.component("codec", "bugger").load()


class Late:
    """A plugin as one writes it in a notebook."""

    @hookimpl
    def register_metrics(self, registry: Registry) -> None:
        registry.add("late", f"{__name__}:Late")


def test_late_registration() -> None:
    catalog = loaded()
    catalog.add_plugin(Late(), "notebook")
    assert catalog.component("metric", "late").plugin == "notebook"
    with pytest.raises(PluginError, match="already loaded"):
        catalog.add_plugin(Late(), "notebook")
    assert "late" in catalog.registry("metric")  # the second attempt took nothing away


def test_a_failed_late_registration_can_be_repeated() -> None:
    class Broken:
        @hookimpl
        def register_metrics(self, registry: Registry) -> None:
            registry.add("late", "x:Y")
            raise ValueError("half way")

    catalog = loaded()
    with pytest.raises(ValueError, match="half way"):
        catalog.add_plugin(Broken(), "notebook")
    catalog.add_plugin(Late(), "notebook")
    assert catalog.component("metric", "late").target.endswith(":Late")


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(RecipeError, match="did you mean 'push_cube'"):
        REFERENCE.component("environment", "push_cub")
    with pytest.raises(RecipeError, match=r"unknown codec 'zzz'; known: .*compact"):
        REFERENCE.component("codec", "zzz")
    assert suggest("place", ["palace", "push_cube.place"]) == "; did you mean 'push_cube.place'?"


@pytest.mark.parametrize("order", [1, -1])
def test_a_task_reaches_its_environment_whichever_plugin_comes_first(order: int) -> None:
    catalog = Catalog()
    environments = plugin_of(environments={"there": "theirs:There"})
    tasks = plugin_of(tasks={"there.tidy": "mine:TIDY"})
    for plugin, name in [(environments, "environments"), (tasks, "tasks")][::order]:
        catalog.add_plugin(plugin, name)
    assert catalog.component("environment", "there").tasks == {"tidy": "mine:TIDY"}
