"""Charts as SVG in the colours of the page around them, and as PNG and PDF files."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from acwm_core.files import written_whole

SIZE = (5.2, 3.1)
"""Width and height in inches; the page scales the drawing."""

INK, GRID = "#000001", "#000002"
"""Placeholders for the page's colours, replaced in the SVG by CSS variables."""

_CSS = resources.files("acwm_report").joinpath("templates/report.css").read_text("utf-8")
PAPER = dict(re.findall(r"--(\w+): (#\w{6})", _CSS[: _CSS.index("@media")]))
"""The page's light-mode colours by CSS variable name, for figures on white paper."""

_STYLE = {
    "svg.fonttype": "none",  # keep text as text
    "text.parse_math": False,  # do not read names as formulas
    "font.size": 9.5,
    "axes.edgecolor": GRID,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    **{f"{axis}tick.{which}.size": 0 for axis in "xy" for which in ("major", "minor")},
    "lines.linewidth": 1.9,
    "lines.solid_capstyle": "round",
}

_MATPLOTLIB: Any = mpl  # its type annotations are incomplete

_SVGS: dict[str, Markup] = {}
MOST_SVGS = 64
"""Charts of this process that are kept: whoever writes a page again draws only what has changed."""

Numbers = Sequence[float | None]
"""Values to draw; None leaves a gap."""


@dataclass(frozen=True)
class Curve:
    """One curve, or a cloud of points."""

    title: str  # in the legend; ``""`` leaves it out of the legend
    colour: str  # name of the page's CSS variable, e.g. ``"model"`` for ``--model``
    x: Sequence[float]  # x values
    y: Numbers  # y values
    # ``"-"``, ``"--"``, ``"."`` for points only, or ``"raw"``: thin and pale, like the data
    # under a smoothed curve
    style: str = "-"
    low: Numbers = ()  # lower ends of the intervals of `y`, if they have any
    high: Numbers = ()  # upper ends

    def draw(self, axes: Any, colour: str, marker: str | None) -> None:
        """Draw the curve and its interval on Matplotlib axes, with `marker` at each value."""
        values = np.array(self.y, float)
        if self.style == ".":
            axes.scatter(self.x, values, s=26, color=colour, alpha=0.75, linewidths=0)
            return
        line = {"linewidth": 0.8, "alpha": 0.45} if self.style == "raw" else {}
        dashes: Any = (0, (4, 2.5)) if self.style == "--" else "-"
        shown = {"color": colour, "linestyle": dashes, "marker": marker, "markersize": 4.5}
        axes.plot(self.x, values, **shown, **line)
        if self.low and self.high:
            edges = np.array([self.low, self.high], float)
            axes.fill_between(self.x, *edges, color=colour, alpha=0.15, linewidth=0)


@dataclass(frozen=True)
class Chart:
    """Curves over one x axis, with their title and labels."""

    title: str  # its heading
    name: str  # unique on the page; exported files are named after it, without the run's key
    curves: Sequence[Curve]  # drawn in order, the last on top
    x_label: str  # label of the x axis, with its unit
    y_label: str  # label of the y axis, with its unit
    points: bool = False  # whether to mark the values
    ticks: Sequence[tuple[float, str]] = ()  # positions and texts of the x ticks; default if empty
    log_x: bool = False  # whether the x axis is logarithmic
    log_y: bool = False  # whether the y axis is logarithmic
    shaded: tuple[float, float] | None = None  # a range of the x axis to shade

    @property
    def legend(self) -> list[tuple[str, str, bool]]:
        """Title, colour and whether the line is dashed, for each curve with a title."""
        return [(c.title, c.colour, c.style == "--") for c in reversed(self.curves) if c.title]

    @property
    def description(self) -> str:
        """What the chart shows in words, for screen readers."""
        named = [(curve.title, curve.y[-1]) for curve in self.curves if curve.title]
        ends = ", ".join(f"{title} {last:.3g}" for title, last in named if last is not None)
        at_the_end = f"; at the end {ends}" if ends else ""
        return f"{self.title}: {self.y_label} against {self.x_label}{at_the_end}."

    @property
    def svg(self) -> Markup:
        """Inline SVG in the colours and fonts of the page around it."""
        key = json.dumps(asdict(self), default=lambda numbers: numbers.tolist())
        if key not in _SVGS:
            if len(_SVGS) >= MOST_SVGS:
                _SVGS.clear()
            _SVGS[key] = self._svg()
        return _SVGS[key]

    def _svg(self) -> Markup:
        names = dict.fromkeys([*(curve.colour for curve in self.curves), "line"])
        palette = {name: f"#0000{index:02x}" for index, name in enumerate(names, start=16)}
        file = io.StringIO()
        with _MATPLOTLIB.rc_context({**_STYLE, "svg.hashsalt": self.name}):
            figure, _ = self._drawn(palette)
            nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
            figure.savefig(file, format="svg", transparent=True, metadata=nothing)
        prefix = re.sub(r"[^A-Za-z0-9_-]", "-", self.name)  # it becomes part of the markup
        return Markup(_embeddable(file.getvalue(), prefix, palette))

    def save(self, path: Path) -> None:
        """Draw on white with title and legend; the ending of `path` decides between PNG and PDF."""
        lines = {"axes.edgecolor": "#c4c4c0", "grid.color": PAPER["line"]}
        with _MATPLOTLIB.rc_context({**_STYLE, "pdf.fonttype": 42, **lines}):
            figure, axes = self._drawn(PAPER)
            axes.set_title(self.title, fontsize=10.5, loc="left", color=PAPER["truth"])
            handles: list[Any] = [
                Line2D([], [], color=PAPER[colour], linestyle="--" if dashed else "-", label=title)
                for title, colour, dashed in self.legend
            ]
            if handles:
                axes.legend(handles=handles, frameon=False, fontsize=8.5)
            undated = {"CreationDate": None} if path.suffix == ".pdf" else {}
            with written_whole(path) as partial:
                figure.savefig(partial, format=path.suffix[1:], dpi=200, metadata=undated)

    def _drawn(self, palette: Mapping[str, str]) -> tuple[Any, Any]:
        figure: Any = Figure(figsize=SIZE, layout="constrained")
        axes: Any = figure.add_subplot()
        if self.shaded:
            axes.axvspan(*self.shaded, color=palette["line"], alpha=0.45, linewidth=0)
        for curve in self.curves:
            curve.draw(axes, palette[curve.colour], "o" if self.points else None)
        axes.set(xlabel=self.x_label, ylabel=self.y_label)
        axes.margins(x=0.03 if self.points else 0.01)
        if self.log_x:
            axes.set_xscale("log")
        if self.ticks:
            axes.set_xticks([place for place, _ in self.ticks], [text for _, text in self.ticks])
            axes.set_xticks([], minor=True)
        if self.log_y:
            values = [y for curve in self.curves for y in curve.y if y]
            narrow = bool(values) and max(values) / min(values) < 10
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}" if narrow else "")
        return figure, axes


def _embeddable(svg: str, name: str, palette: Mapping[str, str]) -> str:
    """Remove the file header and fixed size, and use the colours and fonts of the page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = svg.replace("<svg", '<svg aria-hidden="true" focusable="false"', 1)
    svg = re.sub(r"(font: [\d.]+px) [^;\"]*", r"\1 var(--sans)", svg)
    svg = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\1{name}-", svg)
    for colour, variable in [(INK, "muted"), (GRID, "line"), *((c, n) for n, c in palette.items())]:
        svg = svg.replace(colour, f"var(--{variable})")
    return svg
