"""Whatever a plugin does when it is imported, every other one works on."""

import signal
import sys
from pathlib import Path

import pytest

from tests.catalog.installing import Install, loaded, reasons, unharmed


def test_one_that_raises_on_import(install: Install) -> None:
    install("plugin_raises", "raise RuntimeError('boom')")
    catalog = loaded()
    line = Path(sys.path[0]) / "plugin_raises.py"
    assert reasons(catalog) == {"plugin_raises": f"RuntimeError: boom, in plugin_raises ({line}:2)"}
    assert unharmed(catalog)


@pytest.mark.parametrize(
    ("end", "told"),
    [
        ("raise SystemExit('no\\nlicence')", "SystemExit: no licence"),
        ("raise EOFError", "EOFError, in plugin_exits ("),
    ],
)
def test_one_that_ends_the_process_on_import(install: Install, end: str, told: str) -> None:
    install("plugin_exits", end)
    catalog = loaded()
    assert [*reasons(catalog)] == ["plugin_exits"]
    assert reasons(catalog)["plugin_exits"].startswith(told)
    assert unharmed(catalog)


def test_ctrl_c_while_a_plugin_is_imported_stops_the_program(install: Install) -> None:
    install("plugin_stopped", "import signal\nsignal.raise_signal(signal.SIGINT)")
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        loaded()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("added", "told"),
    [
        ("3, 'x:Y'", "name of codec 3 is of the wrong type: 3"),
        ("'x', None", "target of codec 'x' is of the wrong type: None"),
        ("'x', 'x:Y', summary=5", "summary of codec 'x' is of the wrong type: 5"),
        ("'x', 'x:Y', extra=['a']", "extra of codec 'x' is of the wrong type: ['a']"),
        ("'x', 'x:Y', requires='mujoco'", "requires of codec 'x' is of the wrong type: 'mujoco'"),
        ("'x', 'x:Y', requires=(1,)", "requires[0] of codec 'x' is of the wrong type: 1"),
        ("'x', 'x:Y', physics=len", "physics of codec 'x' is of the wrong type: <built-in"),
        ("'a b', 'x:Y'", "codec 'a b' must consist"),
        ("'', 'x:Y'", "codec '' must consist"),
        ("'x', ':Y'", "is not 'module:Name'"),
        ("'x', 'x.y:Y.z'", "is not 'module:Name'"),
        ("'x'", "TypeError: "),
    ],
)
def test_one_that_registers_wrong_types(install: Install, added: str, told: str) -> None:
    install(
        "plugin_types",
        f"""
        @hookimpl
        def register_codecs(registry):
            registry.add("fine", "plugin_types:Codec")
            registry.add({added})
        """,
    )
    catalog = loaded()
    assert told in reasons(catalog)["plugin_types"]
    assert "plugin_types.py:6)" in reasons(catalog)["plugin_types"]
    assert "fine" not in catalog.registry("codec")
    assert unharmed(catalog)


@pytest.mark.parametrize(
    "harm",
    [
        "registry._components.clear()",
        "registry._components = {}",
        "registry._components = None",
        "registry.__init__('metric')",
        "registry.restore({})",
        "registry._components['compact'] = registry._components['identity']",
    ],
)
def test_one_that_clears_the_registry(install: Install, harm: str) -> None:
    install(
        "plugin_clears",
        f"""
        @hookimpl
        def register_codecs(registry):
            registry.add("fine", "plugin_clears:Codec")
            {harm}
        """,
    )
    catalog = loaded()
    assert [*reasons(catalog)] == ["plugin_clears"]
    assert unharmed(catalog)
    assert catalog.component("codec", "compact").plugin == "acwm_codecs"
    assert "plugin_clears" not in catalog.plugins


@pytest.mark.parametrize("damage", [b"[acwm]\nfoo\n", b"\xff\xfe[acwm]"])
def test_a_package_with_damaged_metadata(install: Install, damage: bytes) -> None:
    install("plugin_damaged", "")
    (Path(sys.path[0]) / "plugin_damaged-1.0.dist-info/entry_points.txt").write_bytes(damage)
    catalog = loaded()
    (problem,) = catalog.problems
    assert problem.plugin.endswith("plugin_damaged-1.0.dist-info")
    assert unharmed(catalog)


def test_one_that_is_no_plugin(install: Install) -> None:
    install("plugin_bare", "def register_codecs(registry): pass")
    assert "implements no hook" in reasons(loaded())["plugin_bare"]


def test_two_names_for_one_plugin(install: Install) -> None:
    install(
        "plugin_alias",
        """
        @hookimpl
        def register_codecs(registry):
            registry.add("alias", "plugin_alias:Codec")
        """,
    )
    points = Path(sys.path[0]) / "plugin_alias-1.0.dist-info/entry_points.txt"
    points.write_text("[acwm]\nfirst = plugin_alias\nsecond = plugin_alias\n")
    catalog = loaded()
    assert catalog.component("codec", "alias").plugin == "first"
    assert [*reasons(catalog)] == ["second"]
    assert unharmed(catalog)
