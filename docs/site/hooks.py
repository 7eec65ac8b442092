"""Hooks of MkDocs: generated pages, and links that lead out of docs/.

Pages stay as they are on the code host. A link to a file outside of docs/ leads to the page of the
site that shows that file.
"""

import functools
import re
import sys
from pathlib import Path
from typing import Any

import jupytext
from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

import environments_text
import links
from commands import commands_page
from components import components_page, recipe_keys_page

ROOT = Path(__file__).resolve().parents[2]

MARKERS = {
    "commands": commands_page,
    "components": components_page,
    "environments": lambda: environments_text.sections(environments_text.cards()),
    "recipe-keys": recipe_keys_page,
}
"""Functions whose result replaces ``<!-- generated: NAME -->`` in a page."""

_SAVED = re.compile(r'picture\.save\("([\w.]+)"\)')
"""A link to a picture made by a cell of a notebook, stored in docs/notebooks/."""


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that lie outside of docs/: documents, notebooks and the code that is linked."""
    for name, uri in links.DOCUMENTS.items():
        files.append(File.generated(config, uri, content=(ROOT / name).read_text()))
    for name, uri in links.notebooks().items():
        notebook = jupytext.read(ROOT / name)
        text = jupytext.writes(notebook, "ipynb")
        files.append(File.generated(config, uri.replace(".md", ".ipynb"), content=text))
        files.append(File.generated(config, uri, content=_notebook(notebook, name)))
    pages = [(links.place_of(file.src_uri), file) for file in files.documentation_pages()]
    linked = {found for place, file in pages for found in links.code(place, file.content_string)}
    for path in sorted(linked):
        uri = links.uri_of(path)
        files.append(File.generated(config, uri, content=links.listing(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert generated content, and point links out of docs/ to the pages that show the files."""
    uri = page.file.src_uri
    if uri == "index.md":  # said here, as code hosts show what stands at the head of a page
        page.meta["hide"] = ["navigation", "toc"]
    if uri == "changelog.md":
        page.meta["search"] = {"exclude": True}
    if not uri.startswith("source/"):
        markdown = links.rewritten(markdown, links.place_of(uri), uri)
    return re.sub(r"<!-- generated: ([\w-]+) -->", lambda found: _filled(found[1]), markdown)


@functools.cache
def _filled(name: str) -> str:
    return MARKERS[name]()


def _notebook(notebook: Any, name: str) -> str:
    """Render a notebook as a page that says how to get and run it."""
    cells = []
    for cell in notebook.cells:
        code = cell.cell_type == "code"
        cells.append(f"```python\n{cell.source}\n```" if code else cell.source)
        for picture in _SAVED.findall(cell.source):
            cells.append(f"![The picture that this cell makes]({picture})")
    title, *rest = cells
    stem = Path(name).stem
    about = f"[Download the notebook]({stem}.ipynb), or run it as a script: `python {name}`."
    return "\n\n".join([title, about, *rest]) + "\n"
