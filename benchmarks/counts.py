"""Lines of Python by room, participles as names, and names of several classes, at some commits.

    python benchmarks/counts.py HEAD 022984a4

A room is the folder of a plugin or of a part of core. Names are counted in the rooms that `NAMED`
lists, as tokens of the code, and not in texts; classes in core and the plugins.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter

PARTICIPLES = ("each", "found", "made", "told", "heard", "sent", "drawn", "shown")
NAMED = ("acwm_core", "acwm_planning", "acwm_formats", "acwm_play", "acwm_scene", "acwm_recurrent")


def sources(revision: str) -> dict[str, str]:
    """The Python files of a commit by their paths."""
    listing = subprocess.check_output(["git", "ls-tree", "-r", "-z", revision], text=True)
    entries = [line.split("\t") for line in listing.split("\0") if line.endswith(".py")]
    hashes = "\n".join(facts.split()[2] for facts, _ in entries)
    command = ["git", "cat-file", "--batch=%(objectsize)"]
    stream = io.BytesIO(subprocess.run(command, input=hashes.encode(), stdout=-1).stdout)
    texts = dict[str, str]()
    for _, path in entries:
        texts[path] = stream.read(int(stream.readline()) + 1)[:-1].decode()
    return texts


def room_of(path: str) -> str:
    """The room of a file."""
    parts = path.split("/")
    deep = parts[0] in ("acwm_core", "plugins") and len(parts) > 2
    return "/".join(parts[:2]) if deep else parts[0]


def lines_by_room(texts: dict[str, str]) -> Counter[str]:
    """Lines of code, comments and texts by room."""
    count = Counter[str]()
    for path, text in texts.items():
        count[room_of(path)] += text.count("\n")
    return count


def participles_in(texts: dict[str, str]) -> Counter[str]:
    """How often each of `PARTICIPLES` is a name, by the package."""
    count = Counter[str]()
    for path, text in texts.items():
        package = path.removeprefix("plugins/").partition("/")[0]
        if package in NAMED:
            tokens = tokenize.generate_tokens(io.StringIO(text).readline)
            names = (token.string for token in tokens if token.type == tokenize.NAME)
            count[package] += sum(name in PARTICIPLES for name in names)
    return count


def shared_names(texts: dict[str, str]) -> list[str]:
    """Names that several classes of core and the plugins have."""
    count = Counter[str]()
    for path, text in texts.items():
        if path.startswith(("acwm_core/", "plugins/")) and "/templates/" not in path:
            body = ast.parse(text).body
            count.update(node.name for node in body if isinstance(node, ast.ClassDef))
    return [f"{name} ×{number}" for name, number in sorted(count.items()) if number > 1]


def main(revisions: list[str]) -> None:
    """Print the counts of some commits."""
    files = {revision: sources(revision) for revision in revisions}
    lines = {revision: lines_by_room(texts) for revision, texts in files.items()}
    for room in sorted({room for counts in lines.values() for room in counts}):
        print(f"{room:32}", *(f"{counts[room]:9,}" for counts in lines.values()))
    print(f"{'all rooms':32}", *(f"{counts.total():9,}" for counts in lines.values()))
    for revision, texts in files.items():
        print(revision, "participles:", dict(participles_in(texts)))
        print(revision, "classes of one name:", ", ".join(shared_names(texts)))


if __name__ == "__main__":
    main(sys.argv[1:] or ["HEAD"])
