"""An HTML page for a table of plans: its rows, and videos of what happened and was imagined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, select_autoescape

from acwm_core.files import writing, written_whole
from acwm_planning.settings import ROW_NAMES, words_of
from acwm_planning.table import HEADS, VIDEOS, RowSummary

PAGE_FILE = "index.html"

_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; media-src 'self' file:;
 style-src 'unsafe-inline'">
<title>{{ title }}</title>
<style>
 :root { color-scheme: light dark }
 body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums }
 th, td { padding: .25rem 1rem .25rem 0; text-align: right; border-bottom: 1px solid #8885 }
 th:first-child, td:first-child { text-align: left }
 .wide { overflow-x: auto } figure { margin: 1.5rem 0 } video { max-width: 100%; display: block }
 .quiet { opacity: .7 }
</style></head><body>
<h1>{{ title }}</h1>
<p class="quiet">{{ settings }}</p>
<div class="wide"><table>
<tr>{% for head in heads %}<th>{{ head }}{% endfor %}</tr>
{% for row in rows %}<tr><td>{{ row.cells()|join("\n<td>"|safe) }}</tr>
{% endfor %}</table></div>
<p class="quiet">Intervals are exact (Clopper and Pearson), p is of McNemar's test against the first
row, on the same episodes; distances are means in the end and at the start.</p>
{% for each in videos %}<figure><video controls loop muted preload="metadata" src="{{ each.file }}">
</video><figcaption>{{ each.row }}, episode {{ each.seed }}: {{ each.panels }}</figcaption></figure>
{% endfor %}</body></html>
"""


def write_page(
    folder: Path, title: str, settings: Mapping[str, Any], rows: Sequence[RowSummary]
) -> Path:
    """Write the page of a results folder, which also holds the videos.

    Args:
        folder: the results folder.
        title: title of the page, e.g. the task and its environment.
        settings: settings that determine the results.
        rows: the table.
    """
    videos: list[dict[str, str]] = []
    for row in ROW_NAMES:
        panels = "happened, imagined, goal" if row == "model" else "happened, goal"
        for file in sorted((folder / VIDEOS).glob(f"{row}-*.mp4")):
            seed = file.stem.rpartition("-")[2].lstrip("0") or "0"
            name = f"{VIDEOS}/{file.name}"
            videos.append({"file": name, "row": row, "seed": seed, "panels": panels})
    template = Environment(autoescape=select_autoescape(default=True)).from_string(_TEMPLATE)
    words = " ".join(words_of(settings))
    text = template.render(title=title, settings=words, heads=HEADS, rows=rows, videos=videos)
    page = folder / PAGE_FILE
    with writing(page), written_whole(page) as partial:
        partial.write_text(text, encoding="utf-8")
    return page
