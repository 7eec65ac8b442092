"""Links between files of the repository and pages of the site."""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

DOCUMENTS = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "examples/acwm_pendulum/README.md": "example-plugin.md",
}
"""Documents outside of docs/ and their pages on the site."""

_LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
_FENCE = re.compile(r"(^```.*?^```|^<!--.*?-->)", re.M | re.S)
_LANGUAGES = {".py": "python", ".toml": "toml", ".yaml": "yaml", ".json": "json"}


def notebooks() -> dict[str, str]:
    """Notebook sources and their pages on the site."""
    found = sorted((ROOT / "examples" / "notebooks").glob("*.py"))
    return {str(path.relative_to(ROOT)): f"notebooks/{path.stem}.md" for path in found}


def place_of(uri: str) -> str:
    """The file of the repository that a page is made from."""
    known = {page: name for name, page in {**DOCUMENTS, **notebooks()}.items()}
    return known.get(uri, f"docs/{uri}")


def uri_of(path: str) -> str:
    """The page or file of the site that shows a file or folder of the repository."""
    if path == "README.md":
        return "index.md"
    if f"{path}/README.md" in DOCUMENTS:
        path = f"{path}/README.md"
    if path in DOCUMENTS:
        return DOCUMENTS[path]
    if path in notebooks():
        return notebooks()[path]
    if path.startswith("examples/notebooks/"):  # beside them: for download, and what they show
        return path.removeprefix("examples/")
    if path.startswith("docs/") and not path.endswith(".py"):
        return path.removeprefix("docs/")
    return f"source/{path}.md"


def code(place: str, text: str) -> Iterator[str]:
    """Files and folders of the repository that a document links to and that have no page."""
    for target in _targets(place, text):
        if uri_of(target).startswith("source/") and (ROOT / target).exists():
            yield target


def rewritten(text: str, place: str, uri: str) -> str:
    """The text of a document with links rewritten for the site."""

    def led(found: re.Match[str]) -> str:
        before, link, anchor, after = found[1], found[2], found[3] or "", found[4]
        if _is_elsewhere(link):
            return found[0]
        target = uri_of(_absolute(place, link))
        return before + posixpath.relpath(target, posixpath.dirname(uri) or ".") + anchor + after

    parts = _FENCE.split(text)
    return "".join(p if _FENCE.match(p) else _LINK.sub(led, p) for p in parts)


def listing(path: str) -> str:
    """A page that shows a file of the repository or lists a folder."""
    head = f"---\nsearch: {{exclude: true}}\n---\n\n# {path}\n\n"
    found = ROOT / path
    if found.is_dir():
        names = sorted(
            each.name for each in found.iterdir() if not each.name.startswith((".", "_"))
        )
        return head + "\n".join(f"- `{name}`" for name in names) + "\n"
    language = _LANGUAGES.get(found.suffix, "text")
    return f"{head}`````{language}\n{found.read_text()}\n`````\n"


def _targets(place: str, text: str) -> Iterator[str]:
    for _, link, _, _ in _LINK.findall("".join(_FENCE.split(text)[::2])):
        if not _is_elsewhere(link):
            yield _absolute(place, link)


def _absolute(place: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(place), link))


def _is_elsewhere(link: str) -> bool:
    return link.startswith(("http:", "https:", "mailto:", "#"))
