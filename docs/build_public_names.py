"""Writes docs/reference/public-names.txt: what others may rely on in core, and so what binds it.

    python docs/build_public_names.py

Modules are read and not imported. A commit that changes the file says which two kinds of component
need the change.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name

ROOT = Path(__file__).parents[1]
FILE = ROOT / "docs/reference/public-names.txt"

HEADER = """\
# The public names of acwm_core, and the keys of recipes that it reads.
# Remake this file by `python docs/build_public_names.py`. A commit that adds a name says which two
# kinds of component need it; what only one needs belongs to that one.
"""


def public_names() -> list[str]:
    """``module:Name`` and ``module:Class.member`` of all that has no leading underscore."""
    found: list[str] = []
    for path in sorted((ROOT / "acwm_core").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        module = ".".join(parts).removesuffix(".__init__")
        if path.name != "__main__.py":
            names = _defined(ast.parse(path.read_text(encoding="utf-8")).body)
            found += [f"{module}:{name}" for name in sorted(names)]
    return found


def recipe_keys() -> list[str]:
    """``section.key``, with the name of the component for those of core's own components."""
    from acwm_core.plugins import OWN
    from acwm_core.recipe.check import SECTIONS
    from acwm_core.recipe.sections import COMPONENTS
    from acwm_core.recipe.signature import signature

    found = [f"{section}=NAME" for section in COMPONENTS]
    for section, target in SECTIONS.items():
        found += [f"{section}.{key}" for key in signature(resolve_name(target)).parameters]
    for kind in ("objective", "executor"):
        for name, (target, *_) in OWN[kind].items():
            taken = signature(resolve_name(f"acwm_core.{target}")).parameters
            found += [f"{kind}={name} {kind}.{key}" for key in taken]
    return sorted(found)


def _defined(body: list[ast.stmt], inside: str = "") -> Iterator[str]:
    """The names that statements define, and in classes their members."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [name for target in node.targets for name in _bound(target)]
        elif isinstance(node, ast.AnnAssign):
            names = [*_bound(node.target)]
        else:
            continue
        for name in names:
            if not name.startswith("_"):
                yield inside + name
                if isinstance(node, ast.ClassDef) and not inside:
                    yield from _defined(node.body, f"{name}.")


def _bound(target: ast.expr) -> Iterator[str]:
    if isinstance(target, ast.Name):
        yield target.id
    elif isinstance(target, ast.Tuple):
        for each in target.elts:
            yield from _bound(each)


def text() -> str:
    """The content of the file."""
    return "\n".join([HEADER, *public_names(), "", *recipe_keys(), ""])


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))  # a checkout's own core, wherever acwm is installed from
    FILE.write_text(text(), encoding="utf-8")
