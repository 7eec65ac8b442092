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
        ("'x', 'x:Y', requires='mujoco'", "requires='mujoco' of codec 'x' must be a tuple"),
        ("'a b', 'x:Y'", "codec 'a b' must consist"),
        ("'', 'x:Y'", "codec '' must consist"),
        ("'x', ':Y'", "is not 'module:Name'"),
        ("'x', 'x.y:Y.z'", "is not 'module:Name'"),
        ("'x'", "TypeError: "),
    ],
)
def test_one_that_registers_what_nobody_could_use(install: Install, added: str, told: str) -> None:
    install(
        "plugin_types",
        f"""
        @hookimpl
        def register_codecs(registry):
            registry.add("sound", "plugin_types:Codec")
            registry.add({added})
        """,
    )
    catalog = loaded()
    assert told in reasons(catalog)["plugin_types"]
    assert "plugin_types.py:6)" in reasons(catalog)["plugin_types"]
    assert "sound" not in catalog.registry("codec")
    assert unharmed(catalog)


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


def test_kinds_of_ones_own(install: Install) -> None:
    """A plugin that comes first in the alphabet may add to a kind that a later one defines."""
    components = """
        @hookimpl
        def register_gadgets(registry):
            registry.add("small", "plugin_a:Gadget")
    """
    install("plugin_a", components)
    assert "register_gadgets" in reasons(loaded())["plugin_a"]
    kind = """
        @hookimpl
        def register_kinds(registry):
            registry.add("gadget", "plugin_z:Gadget", summary="does something")

        @hookimpl
        def register_gadgets(registry):
            registry.add("large", "plugin_z:Gadget")
    """
    install("plugin_z", kind)
    catalog = loaded()
    assert catalog.problems == []
    assert {each.name: each.plugin for each in catalog.registry("gadget")} == {
        "small": "plugin_a",
        "large": "plugin_z",
    }
    assert catalog.kinds[-1] == "gadget"
