"""The documents tell the truth: links lead somewhere, commands parse, code runs or imports."""

import ast
import functools
import importlib
import itertools
import re
import shlex
from pathlib import Path

import click
import pytest
import yaml

from acwm_core.cli import main
from acwm_core.recipe import compose
from acwm_templates.package import write_package

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *ROOT.glob("*.md"),
    *ROOT.glob("docs/**/*.md"),
    *ROOT.glob("examples/*/README.md"),
]
OUTSIDE = [path for path in DOCUMENTS if ROOT / "docs" not in path.parents]


def names(values):
    return [str(path.relative_to(ROOT)) for path in values]


documents = pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))


def blocks(document, language):
    return re.findall(rf"^```{language}\n(.*?)^```", document.read_text(), re.M | re.S)


def commands(document):
    """Every `acwm …` that stands in an indented block, a console, a script or in backquotes."""
    text = document.read_text()
    lines = re.findall(r"^(?: {4}|\$ )(?:srun .*?)?(acwm [^#\n]*)", text, re.M)
    for block in blocks(document, "bash"):
        joined = re.sub(r"\\\n\s*", "", block)
        lines += re.findall(r"^(?:srun .*?)?(acwm [^#\n]*)", joined, re.M)
    return [*lines, *re.findall(r"`(acwm [^`]*)`", text)]


def own_names(document):
    """Components and modules that the page itself writes."""
    text = document.read_text()
    registered = re.findall(r'registry\.add\(\s*"(\w+)"', text)
    return {*registered, *re.findall(r'^```python title="(\w+)\.py"$', text, re.M)}


@pytest.mark.parametrize("document", OUTSIDE, ids=names(OUTSIDE))
def test_links_lead_somewhere(document):
    """Those on pages of the site are checked by its build."""
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if not target.startswith(("http:", "https:")):
            path = target.partition("#")[0]
            assert (document.parent / path).exists(), f"{document.name} links to {target}"


@documents
def test_commands_parse(document):
    for line in commands(document):
        words = shlex.split(line)[1:]
        if "…" not in line:
            parse(main, words, line)


def parse(command, words, line):
    """Read the words down to the last command and its options; folders need not exist."""
    context = click.Context(command, info_name="acwm")
    try:
        _, rest, _ = command.make_parser(context).parse_args(list(words))
        if isinstance(command, click.Group) and rest:
            _, found, rest = command.resolve_command(context, rest)
            parse(found, rest, line)
    except click.UsageError as error:
        pytest.fail(f"{line}: {error.format_message()}")


@documents
def test_recipes_in_commands_are_valid(document):
    for line in commands(document):
        command, *rest = shlex.split(line)[1:] or [""]
        if command not in ("fit", "show") or not rest or rest[0] in ("RECIPE", "…", "--help"):
            continue
        if rest[0].startswith(("runs/", "resume=")):  # of a run that the reader has made
            continue
        if "$ " + line not in misspelt():
            words = itertools.takewhile(lambda word: not word.startswith("--"), rest[1:])
            kept = [w for w in words if w.partition("=")[2] not in own_names(document)]
            composed(rest[0], *(w for w in kept if not w.startswith(("resume=", "env=my_"))))


@functools.cache
def composed(recipe, *words):
    """Pages show the same commands again and again."""
    return compose(recipe, words)


def misspelt():
    """Commands that a document shows for their error."""
    text = (ROOT / "docs" / "recipes.md").read_text()
    return set(re.findall(r"^(\$ acwm .*)\n(?=acwm: )", text, re.M))


def test_errors_in_the_documents_are_what_is_printed(capsys):
    text = (ROOT / "docs" / "recipes.md").read_text()
    shown = re.findall(r"^\$ acwm (.*)\n(acwm: .*)", text, re.M)
    assert shown
    for line, error in shown:
        with pytest.raises(SystemExit) as ended:
            main(shlex.split(line))
        assert ended.value.code == 2
        assert capsys.readouterr().err.strip() == error


@documents
def test_python_blocks_import_what_exists(document):
    own = own_names(document)
    for block in blocks(document, r'python(?: title="[^"\n]*")?'):
        for node in ast.walk(ast.parse(block)):
            names = [alias.name for alias in getattr(node, "names", ()) if hasattr(alias, "asname")]
            if own & {getattr(node, "module", None), *names}:
                continue
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    importlib.import_module(alias.name)


def test_the_recipe_in_the_documents_is_valid(tmp_path):
    (block,) = blocks(ROOT / "docs" / "recipes.md", "yaml")
    path = tmp_path / "shown.yaml"
    path.write_text(block)
    assert compose(str(path), []).conditioner.name == yaml.safe_load(block)["conditioner"]["name"]


def test_code_of_the_example_is_quoted_as_it_is():
    quoted = blocks(ROOT / "docs" / "plugins.md", "python")[0]
    plugin = ROOT / "examples" / "acwm_pendulum" / "acwm_pendulum" / "plugin.py"
    code = re.sub(r'\n    """.*?"""', "", plugin.read_text())
    assert quoted.strip() in code


def test_code_of_a_scene_is_quoted_as_acwm_new_writes_it(tmp_path):
    folder = write_package("scene", "my_world", tmp_path / "acwm_my_world", "push_cube")
    written = "".join(path.read_text() for path in folder.rglob("*.py"))
    shown = blocks(ROOT / "docs" / "scenes.md", "python")
    assert shown
    assert [each for each in shown if each.strip("\n") not in written] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_make_targets_in_the_documents_exist():
    targets = set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.M))
    for document in DOCUMENTS:
        for line in re.findall(r"(?:`|^ {4})make ([a-z -]+)(?:`|$)", document.read_text(), re.M):
            assert set(line.split()) <= targets, line
