"""Rules of the repository that no linter knows: short functions, none left for later."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FUNCTION_LINES = 45
UNFINISHED = re.compile(r"\b(TODO|FIXME|XXX|HACK|NotImplemented\b(?!Error))")

CODE = sorted(
    path
    for folder in ("acwm_core", "plugins", "examples", "tests", "benchmarks", "docs")
    for path in (ROOT / folder).rglob("*.py")
)


def body_lines(function):
    """Lines of a function without its signature, decorators and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def functions(tree):
    kinds = ast.FunctionDef | ast.AsyncFunctionDef
    return [node for node in ast.walk(tree) if isinstance(node, kinds)]


@pytest.fixture(scope="module")
def sources():
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in CODE}


@pytest.fixture(scope="module")
def trees(sources):
    return {name: ast.parse(text) for name, text in sources.items()}


@pytest.mark.ci
def test_functions_are_short(trees):
    found = {
        f"{name}:{f.name}": body_lines(f) for name, tree in trees.items() for f in functions(tree)
    }
    assert {name: n for name, n in found.items() if n > FUNCTION_LINES} == {}


@pytest.mark.ci
def test_text_has_an_encoding(trees):
    """Without one, what is read and written depends on the user's locale."""
    bare = []
    for name, tree in trees.items():
        if name.startswith(("acwm_core/", "plugins/")) and "/templates/" not in name:
            for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
                method = getattr(call.func, "attr", "")
                most = {"read_text": 0, "write_text": 1}.get(method, len(call.args) - 1)
                told = len(call.args) > most or any(k.arg == "encoding" for k in call.keywords)
                bare += [] if told else [f"{name}:{call.lineno}"]
    assert bare == []


def test_nothing_is_left_for_later(sources):
    here = str(Path(__file__).relative_to(ROOT))
    assert [name for name, text in sources.items() if UNFINISHED.search(text)] == [here]


def test_no_large_file_is_tracked():
    """Weights that ship and reference values of tests may have 10 MB, all else 1 MB."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    sizes = {path: path.stat().st_size for path in paths if path.exists()}
    large = {str(path.relative_to(ROOT)): size for path, size in sizes.items() if size > 2**20}
    assert [name for name in large if not re.search("/(weights|reference|models)/", name)] == []
    assert all(size <= 10 * 2**20 for size in large.values())


def test_pictures_are_opened_by_their_kinds(sources, trees):
    """Pillow opens kinds that are programs, unless it is told which it may expect."""
    bare = []
    for name, text in sources.items():
        if not name.startswith("tests/") and "Image.open(" in text:
            calls = (node for node in ast.walk(trees[name]) if isinstance(node, ast.Call))
            for call in (each for each in calls if ast.unparse(each.func) == "Image.open"):
                kinds = any(keyword.arg == "formats" for keyword in call.keywords)
                bare += [] if kinds else [f"{name}:{call.lineno}"]
    assert bare == []
