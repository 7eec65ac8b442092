"""What the package declares is what the code needs."""

import ast
import re
import sys
import tomllib
from importlib.metadata import distributions, entry_points, packages_distributions
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
USED = EXTRAS.keys() - {"all", "dev", "docs"}

MAINTENANCE = {"fast-simplification"}
"""What is needed to make a shipped file anew, and for nothing else."""

OF_LIGHTNING = {"wandb", "mlflow-skinny"}
"""What Lightning imports where a recipe asks for it by `trainer.logger`."""


MODELS = tomllib.loads((ROOT / "plugins/acwm_zoo/models/pyproject.toml").read_text())["project"]


def names(requirements):
    return {canonicalize_name(Requirement(line).name) for line in requirements}


def name_of(function):
    """The last part of the name of what is called."""
    return getattr(function, "attr", getattr(function, "id", ""))


def imported_modules(*folders):
    """Top-level modules of others that the sources import, lazily or not."""
    modules = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules.add(node.module)
            elif isinstance(node, ast.Call) and name_of(node.func).endswith("import_module"):
                modules |= {a.value for a in node.args if isinstance(a, ast.Constant)}
    tops = {str(module).partition(".")[0] for module in modules} - sys.stdlib_module_names
    return {top for top in tops if not top.startswith("acwm_")}


def test_imports_are_declared_and_declarations_imported():
    needed = names([*PROJECT["dependencies"], *(line for e in USED for line in EXTRAS[e])])
    declared = needed | MAINTENANCE
    brought_by = packages_distributions()
    used = set()
    for module in imported_modules("acwm_core", "plugins"):
        bringers = {canonicalize_name(name) for name in brought_by[module]}
        assert bringers & declared, f"{module} is imported and not declared"
        used |= bringers
    assert needed - used == OF_LIGHTNING


def test_all_that_names_the_version_names_the_same():
    version = PROJECT["version"]
    assert (MODELS["version"], MODELS["dependencies"]) == (version, [f"acwm=={version}"])
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()


def test_constraints_pin_every_dependency():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins), pins
    required = [*PROJECT["dependencies"], *(line for extra in EXTRAS.values() for line in extra)]
    assert names(required) - {"acwm"} - names(pins) == set()


def test_pinned_versions_run_on_the_lowest_python():
    """Systems keep the patch release that they came with: Debian 12 has Python 3.11.2."""
    lowest = PROJECT["requires-python"].removeprefix(">=")
    pins = set((ROOT / "constraints.txt").read_text().split())
    pinned = [each for each in distributions() if f"{each.name}=={each.version}" in pins]
    assert len(pinned) > 50
    for each in pinned:
        accepted = SpecifierSet(each.metadata.get("Requires-Python") or "")
        assert f"{lowest}.0" in accepted, f"{each.name} {each.version} needs Python {accepted}"


def test_the_extra_all_is_the_sum_of_the_others():
    (line,) = EXTRAS["all"]
    assert Requirement(line).extras == USED


def test_every_plugin_has_an_entry_point():
    plugins = {path.parent.name for path in (ROOT / "plugins").glob("*/plugin.py")}
    assert PROJECT["entry-points"]["acwm"] == {name: f"{name}.plugin" for name in plugins}
    assert {found.name for found in entry_points(group="acwm")} >= plugins
