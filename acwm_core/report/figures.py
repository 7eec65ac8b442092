"""Charts, drawn as SVG in the colours of the page around them, or as PNG and PDF."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

SIZE = (5.2, 3.1)
"""Inches; the page scales the drawing."""

INK, GRID = "#000001", "#000002"
"""Stand-ins for the page's colours, replaced in the SVG by CSS variables."""

PAPER_INK = "#1b1d22"
PAPER: Mapping[str, str] = {
    "line": "#e2e2dd",
    "truth": "#1b1d22",
    "model": "#2450d8",
    "shuffled": "#c2560c",
    "copy": "#767c88",
    "codec": "#0b7d63",
    "perturbed": "#9b2fae",
    "run1": "#2450d8",
    "run2": "#c2560c",
    "run3": "#0b7d63",
    "run4": "#9b2fae",
    "run5": "#8a6d00",
    "run6": "#c0285c",
    "run7": "#0b7896",
    "run8": "#7a4a21",
}
"""The page's light colours, for figures on white paper."""

_STYLE: Mapping[str, Any] = {
    "svg.fonttype": "none",  # text stays text
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
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 1.9,
    "lines.solid_capstyle": "round",
}


@dataclass(frozen=True)
class Line:
    """One curve.

    Attributes:
        title: for the legend.
        colour: name of the page's CSS variable, e.g. ``"model"`` for ``--model``.
        x: abscissae.
        y: ordinates; None leaves a gap.
        dashed: drawn with dashes.
        faint: drawn thin and pale, as the raw data under a smoothed curve.
        low: lower ends of the ordinates' intervals, if they have any.
        high: upper ends.
    """

    title: str
    colour: str
    x: Sequence[float]
    y: Sequence[float | None]
    dashed: bool = False
    faint: bool = False
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()


@dataclass(frozen=True)
class Drawing:
    """What stands on a pair of axes, not yet drawn.

    Attributes:
        draw: draws on Matplotlib's axes, in the colours that it is given by name.
        colours: the names that it asks for.
    """

    draw: Callable[[Any, Mapping[str, str]], None]
    colours: tuple[str, ...]


def line_chart(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    x_ticks: Sequence[float] = (),
    points: bool = False,
    labels: Sequence[tuple[float, str]] = (),
    shaded: tuple[float, float] | None = None,
) -> Drawing:
    """Curves over one axis.

    Args:
        lines: drawn in order, the last on top.
        x_label: what the abscissa is, with its unit.
        y_label: what the ordinate is, with its unit.
        log: the ordinate is logarithmic.
        x_ticks: if given, the abscissa is logarithmic with these marks alone.
        points: mark the values.
        labels: if given, where the abscissa is marked, and with what.
        shaded: a range of the abscissa that is set off.
    """

    def draw(axes: Any, palette: Mapping[str, str]) -> None:
        if shaded:
            axes.axvspan(*shaded, color=palette["line"], alpha=0.45, linewidth=0)
        for line in lines:
            axes.plot(
                list(line.x),
                [float("nan") if y is None else y for y in line.y],
                color=palette[line.colour],
                linestyle=(0, (4, 2.5)) if line.dashed else "-",
                linewidth=0.8 if line.faint else None,
                alpha=0.45 if line.faint else None,
                marker="o" if points else None,
                markersize=4.5,
            )
            _draw_band(axes, line, palette[line.colour])
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.margins(x=0.03 if points else 0.01)
        if x_ticks:
            axes.set_xscale("log")
            axes.set_xticks(list(x_ticks), [f"{tick:g}" for tick in x_ticks])
            axes.set_xticks([], minor=True)
        if labels:
            axes.set_xticks([place for place, _ in labels], [text for _, text in labels])
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(_plain_minor(line.y for line in lines))

    return Drawing(draw, tuple(dict.fromkeys([*(line.colour for line in lines), "line"])))


def _draw_band(axes: Any, line: Line, colour: str) -> None:
    """The interval around a curve, where it has one."""
    if line.low and line.high:
        low, high = (
            [float("nan") if y is None else y for y in edge] for edge in (line.low, line.high)
        )
        axes.fill_between(list(line.x), low, high, color=colour, alpha=0.15, linewidth=0)


def pair_chart(
    x: Sequence[float], y: Sequence[float], colour: str, x_label: str, y_label: str
) -> Drawing:
    """One point per clip around the diagonal of equal scores; what is not finite is left out."""
    pairs = [pair for pair in zip(x, y, strict=True) if all(map(math.isfinite, pair))]
    values = [value for pair in pairs for value in pair] or [0.0]
    low, high = min(values), max(values)
    margin = 0.06 * (high - low or 1)
    bounds = low - margin, high + margin

    def draw(axes: Any, palette: Mapping[str, str]) -> None:
        axes.plot(bounds, bounds, color=INK, linewidth=0.9, alpha=0.6)
        horizontal, vertical = [a for a, _ in pairs], [b for _, b in pairs]
        axes.scatter(horizontal, vertical, s=26, color=palette[colour], alpha=0.75, linewidths=0)
        axes.set(xlabel=x_label, ylabel=y_label, xlim=bounds, ylim=bounds)

    return Drawing(draw, (colour,))


def _plain_minor(curves: Iterable[Sequence[float | None]]) -> str:
    """Format of minor ticks: numbers where the axis spans little, else nothing."""
    values = [y for curve in curves for y in curve if y]
    return "{x:g}" if values and max(values) / min(values) < 10 else ""


def to_svg(name: str, drawing: Drawing) -> str:
    """Inline SVG in the colours and fonts of the page around it.

    Args:
        name: unique on the page; keeps the ids inside the drawing apart.
        drawing: what to draw.
    """
    palette = {
        colour: f"#0000{index:02x}" for index, colour in enumerate(drawing.colours, start=16)
    }
    file = io.StringIO()
    with _style({"svg.hashsalt": name}):
        figure: Any = Figure(figsize=SIZE, layout="constrained")
        drawing.draw(figure.add_subplot(), palette)
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=nothing)
    return _embeddable(file.getvalue(), name, palette)


def write_figure(
    drawing: Drawing, path: Path, title: str, legend: Sequence[tuple[str, str, bool]] = ()
) -> None:
    """Draw on white paper, as PNG or PDF by the ending of `path`.

    Args:
        drawing: what to draw.
        path: the file.
        title: above it.
        legend: title, colour and whether it is dashed, per curve.
    """
    with _style({"pdf.fonttype": 42, "axes.edgecolor": "#c4c4c0", "grid.color": "#e2e2dd"}):
        figure: Any = Figure(figsize=SIZE, layout="constrained")
        axes: Any = figure.add_subplot()
        drawing.draw(axes, PAPER)
        axes.set_title(title, fontsize=10.5, loc="left", color=PAPER_INK)
        handles: list[Any] = [
            Line2D([], [], color=PAPER[colour], linestyle="--" if dashed else "-", label=name)
            for name, colour, dashed in legend
        ]
        if handles:
            axes.legend(handles=handles, frameon=False, fontsize=8.5)
        figure.savefig(path, dpi=200, metadata={"CreationDate": None} if _is_pdf(path) else {})


def _is_pdf(path: Path) -> bool:
    return path.suffix == ".pdf"


def _style(more: Mapping[str, Any]) -> Any:
    matplotlib: Any = mpl  # its types are not complete
    return matplotlib.rc_context({**_STYLE, **more})


def _embeddable(svg: str, name: str, palette: Mapping[str, str]) -> str:
    """The drawing without its file header, scaled by the page, in the page's colours and fonts."""
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
