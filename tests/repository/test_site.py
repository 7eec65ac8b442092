"""The site: built strictly; links, headings, alternative texts; every command is on it."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import click
import pytest

from acwm_core.catalog import catalog
from acwm_core.cli import main
from acwm_core.recipe import compose
from acwm_core.recipe.recipe import flat_items

for needed in ("mkdocs", "material", "mkdocstrings", "jupytext"):
    pytest.importorskip(needed, reason="needs the extra docs: pip install 'acwm[docs]'")

ROOT = Path(__file__).parents[2]


class Page(HTMLParser):
    """What a page holds; headings and pictures are those of its text alone."""

    def __init__(self, path):
        super().__init__()
        self.ids, self.links, self.headings, self.nameless = set(), [], [], []
        self._article = 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.ids |= {given[name] for name in ("id", "name") if given.get(name)}
        self.links += [given[name] for name in ("href", "src") if given.get(name)]
        self._article += tag == "article"
        if self._article and re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "img" and not given.get("alt"):
            self.nameless.append(given.get("src"))

    def handle_endtag(self, tag):
        self._article -= tag == "article"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}


def test_every_link_and_anchor_exists(site, pages):
    broken = []
    for path, page in pages.items():
        for link in page.links:
            if re.match(r"[a-z]+:", link):
                continue
            place, _, anchor = unquote(link).partition("#")
            target = (path.parent / place).resolve() if place else path
            there = pages[target].ids if target in pages else {anchor}
            if not target.exists() or (anchor and anchor not in there):
                broken.append(f"{path.relative_to(site)}: {link}")
    assert broken == []


def test_pictures_have_alternative_texts_and_headings_an_order(site, pages):
    for path, page in pages.items():
        name = str(path.relative_to(site))
        assert page.nameless == [], name
        assert page.headings.count(1) == 1, name
        steps = zip(page.headings, page.headings[1:], strict=False)
        assert all(after <= before + 1 for before, after in steps), (name, page.headings)


def test_nothing_is_fetched_from_elsewhere(site):
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert re.findall(r'<(?:script|img|link rel="stylesheet")[^>]*="https?://', text) == [], (
            path
        )


def walk(command, path):
    context = click.Context(command)
    for name in command.list_commands(context):
        found = command.get_command(context, name)
        if isinstance(found, click.Group):
            yield from walk(found, (*path, name))
        else:
            yield (*path, name), found


def shown(parameter):
    return isinstance(parameter, click.Option) and not parameter.hidden


def test_the_reference_lists_every_command_and_option(site):
    text = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    for path, command in walk(main, ()):
        words = " ".join(path)
        _, heading, section = text.partition(f'<h2 id="acwm-{"-".join(path)}">')
        section = section.partition("<h2 ")[0]
        assert heading, words
        assert command.help, words
        for option in (each for each in command.params if shown(each)):
            assert option.help, f"{words} {option.opts[0]}"
            assert f"<code>{option.opts[0]}" in section, f"{words} {option.opts[0]}"


def test_the_reference_lists_every_key_of_a_recipe_and_every_component(site):
    keys = (site / "reference" / "recipe-keys.html").read_text(encoding="utf-8")
    recipe = compose("push_cube_small").to_dict()
    sections = ("flow", "training", "data", "evaluation", "trainer")
    for name, _ in flat_items({section: recipe[section] for section in sections}):
        assert f"<code>{name}</code>" in keys, name
    components = (site / "reference" / "components.html").read_text(encoding="utf-8")
    for kind in ("environment", "codec", "model", "conditioner", "metric", "planner", "cost"):
        for component in catalog().registry(kind):
            assert f'id="{kind}-{component.name}"' in components, component.part


def test_every_key_is_described(site):
    text = (site / "reference" / "recipe-keys.html").read_text(encoding="utf-8")
    rows = re.findall(r"<tr>\s*<td><code>([\w.]+)</code>(.*?)</tr>", text, re.S)
    assert len(rows) > 80
    assert [key for key, row in rows if re.search(r"<td></td>\s*$", row)] == []
