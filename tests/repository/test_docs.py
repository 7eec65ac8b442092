"""The documents tell the truth: links lead somewhere, commands parse, code runs or imports."""

import ast
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
from acwm_core.recipe.compose import recipe_names

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *ROOT.glob("*.md"),
    *ROOT.glob("docs/*.md"),
    *ROOT.glob("examples/*/README.md"),
]


def names(values):
    return [str(path.relative_to(ROOT)) for path in values]


documents = pytest.mark.parametrize("document", DOCUMENTS, ids=names(DOCUMENTS))


def blocks(document, language):
    return re.findall(rf"^```{language}\n(.*?)^```", document.read_text(), re.M | re.S)


def commands(document):
    """Every `acwm …` that stands as a line of an indented block, a console or in backquotes."""
    text = document.read_text()
    lines = re.findall(r"^(?: {4}|\$ )(acwm [^#\n]*)", text, re.M)
    return [*lines, *re.findall(r"`(acwm [^`]*)`", text)]


@documents
def test_links_lead_somewhere(document):
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
        if command not in ("fit", "show") or not rest or rest[0] in ("RECIPE", "…"):
            continue
        if rest[0].startswith("runs/"):  # the recipe of a run that the reader has made
            continue
        if "$ " + line not in misspelt():
            words = itertools.takewhile(lambda word: not word.startswith("--"), rest[1:])
            compose(rest[0], [w for w in words if not w.startswith(("resume=", "env=my_"))])


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
    for block in blocks(document, "python"):
        for node in ast.walk(ast.parse(block)):
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
    quoted = blocks(ROOT / "CONTRIBUTING.md", "python")[0]
    plugin = ROOT / "examples" / "acwm_pendulum" / "acwm_pendulum" / "plugin.py"
    code = re.sub(r'\n    """.*?"""', "", plugin.read_text())
    assert quoted.strip() in code


def test_the_readme_lists_every_command():
    text = (ROOT / "README.md").read_text()
    for path, _ in walk(main, ()):
        assert f"| `acwm {' '.join(path)}" in text, path


def walk(command, path):
    context = click.Context(command)
    for name in command.list_commands(context):
        found = command.get_command(context, name)
        if isinstance(found, click.Group):
            yield from walk(found, (*path, name))
        else:
            yield (*path, name), found


def test_make_targets_in_the_documents_exist():
    targets = set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.M))
    for document in DOCUMENTS:
        for line in re.findall(r"(?:`|^ {4})make ([a-z -]+)(?:`|$)", document.read_text(), re.M):
            assert set(line.split()) <= targets, line


@pytest.mark.parametrize("name", recipe_names())
def test_shipped_recipes_are_valid(name):
    assert compose(name, []).to_yaml()
