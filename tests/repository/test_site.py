"""The site: built strictly; links, headings, alternative texts; every command is on it."""

import functools
import http.server
import json
import os
import re
import subprocess
import sys
import threading
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import click
import pytest

from acwm_core.cli import main
from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from acwm_core.recipe.recipe import flat_items
from tests.browsing import DESK, PHONE

for needed in ("mkdocs", "material", "mkdocstrings", "jupytext"):
    pytest.importorskip(needed, reason="needs the extra docs: pip install 'acwm[docs]'")
for simulator in ("mujoco", "pybullet", "taichi"):  # the page of environments is made from cards
    pytest.importorskip(simulator)

pytestmark = pytest.mark.browser

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


def installed(component):
    """Not one that another test has added to the catalog of this process."""
    return component.distribution is not None


def walk(command, path):
    context = click.Context(command)
    added = {each.name for each in catalog().registry("command") if not installed(each)}
    for name in command.list_commands(context):
        if name in added:
            continue
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
    sections = ("training", "data", "evaluation", "trainer")
    for name, _ in flat_items({section: recipe[section] for section in sections}):
        assert f"<code>{name}</code>" in keys, name
    components = (site / "reference" / "components.html").read_text(encoding="utf-8")
    for kind in ("environment", "codec", "model", "conditioner", "metric", "planner", "cost"):
        for component in filter(installed, catalog().registry(kind)):
            assert f'id="{kind}-{component.name}"' in components, component.part


def test_every_key_is_described(site):
    text = (site / "reference" / "recipe-keys.html").read_text(encoding="utf-8")
    rows = re.findall(r"<tr>\s*<td><code>([\w.]+)</code>(.*?)</tr>", text, re.S)
    assert len(rows) > 80
    assert [key for key, row in rows if re.search(r"<td></td>\s*$", row)] == []


CONTRAST = """() => {
  const light = (rgb) => rgb.map((v) => v / 255)
    .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const parts = (text) => [...text.match(/[\\d.]+/g).map(Number), 1].slice(0, 4);
  const over = (top, below, share) => below.map((v, k) => v * (1 - share) + top[k] * share);
  const known = new Map([[null, [255, 255, 255]]]);
  const ground = (each) => {
    if (!known.has(each)) {
      const own = parts(getComputedStyle(each).backgroundColor);
      known.set(each, over(own, ground(each.parentElement), own[3]));
    }
    return known.get(each);
  };
  const faint = [];
  for (const each of document.querySelectorAll("article *, .md-tabs *, .md-sidebar a")) {
    const style = getComputedStyle(each), box = each.getBoundingClientRect();
    const texts = [...each.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    if (!texts || !box.width || each.matches(".headerlink") || !each.checkVisibility(
      {opacityProperty: true, visibilityProperty: true})) continue;
    const below = ground(each), color = parts(style.color);
    const [most, least] = [light(over(color, below, color[3])), light(below)].sort((a, b) => b - a);
    const ratio = (most + 0.05) / (least + 0.05);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || size >= 18.7 && style.fontWeight >= 700;
    if (ratio < (large ? 3 : 4.5)) faint.push(`${each.textContent.trim()} ${ratio.toFixed(2)}`);
  }
  return faint;
}"""
"""Texts with less contrast than WCAG asks for at level AA."""


@pytest.fixture(scope="module")
def address(site):
    """The site as a server shows it."""
    handler = functools.partial(Quiet, directory=site)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.mark.parametrize(
    ("viewport", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk", "phone"]
)
def test_pages_can_be_read_in_a_browser(browser, address, viewport, scheme):
    page = browser.new_page(viewport=viewport, color_scheme=scheme)
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    # A picture that is still on its way when the next page is opened is aborted.
    page.on(
        "requestfailed",
        lambda r: complaints.append(r.url) if "ABORTED" not in (r.failure or "") else None,
    )
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    for name in ("index", "start", "gallery", "reference/commands", "reference/interfaces"):
        page.goto(f"{address}/{name}.html")
        width = page.evaluate("() => document.documentElement.scrollWidth")
        assert width <= viewport["width"], name
        assert page.evaluate(CONTRAST) == [], name
    assert complaints == []
    page.close()


def test_the_search_knows_the_guides(site):
    """The list that the page searches; how it does so is the theme's."""
    listed = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))["docs"]
    found = [each["location"] for each in listed if "conditioner" in each["title"].lower()]
    assert any("own-conditioner" in location for location in found)
    assert any(each["location"].startswith("questions.html") for each in listed)
    assert not [each for each in listed if each["location"].startswith("changelog.html")]
