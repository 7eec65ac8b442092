"""Charts as SVG that takes its colours and fonts from the page around it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

SIZE = (5.2, 3.1)
"""Inches; the page scales the drawing."""

INK, GRID = "#000001", "#000002"
"""Stand-ins for the page's colours, replaced in the SVG by CSS variables."""

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
    """

    title: str
    colour: str
    x: Sequence[float]
    y: Sequence[float | None]
    dashed: bool = False
    faint: bool = False


def line_chart(
    name: str,
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    x_ticks: Sequence[float] = (),
) -> str:
    """Curves over one axis, as inline SVG.

    Args:
        name: unique on the page; keeps the ids inside the drawing apart.
        lines: drawn in order, the last on top.
        x_label: what the abscissa is, with its unit.
        y_label: what the ordinate is, with its unit.
        log: the ordinate is logarithmic.
        x_ticks: if given, the abscissa is logarithmic with these marks alone.
    """
    palette = _palette(line.colour for line in lines)

    def draw(axes: Any) -> None:
        for line in lines:
            axes.plot(
                list(line.x),
                [float("nan") if y is None else y for y in line.y],
                color=palette[line.colour],
                linestyle=(0, (4, 2.5)) if line.dashed else "-",
                linewidth=0.8 if line.faint else None,
                alpha=0.45 if line.faint else None,
            )
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.margins(x=0.01)
        if x_ticks:
            axes.set_xscale("log")
            axes.set_xticks(list(x_ticks), [f"{tick:g}" for tick in x_ticks])
            axes.set_xticks([], minor=True)
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(_plain_minor(line.y for line in lines))

    return _svg(name, draw, palette)


def pair_chart(
    name: str,
    x: Sequence[float],
    y: Sequence[float],
    colour: str,
    x_label: str,
    y_label: str,
) -> str:
    """One point per episode around the diagonal of equal scores, as inline SVG."""
    palette = _palette([colour])
    low, high = min([*x, *y]), max([*x, *y])
    margin = 0.06 * (high - low or 1)
    bounds = low - margin, high + margin

    def draw(axes: Any) -> None:
        axes.plot(bounds, bounds, color=INK, linewidth=0.9, alpha=0.6)
        axes.scatter(x, y, s=26, color=palette[colour], alpha=0.75, linewidths=0)
        axes.set(xlabel=x_label, ylabel=y_label, xlim=bounds, ylim=bounds)

    return _svg(name, draw, palette)


def _plain_minor(curves: Iterable[Sequence[float | None]]) -> str:
    """Format of minor ticks: numbers where the axis spans little, else nothing."""
    values = [y for curve in curves for y in curve if y]
    return "{x:g}" if values and max(values) / min(values) < 10 else ""


def _palette(names: Any) -> dict[str, str]:
    """A stand-in for each named colour of the page."""
    return {name: f"#0000{index:02x}" for index, name in enumerate(dict.fromkeys(names), start=16)}


def _svg(name: str, draw: Callable[[Any], None], palette: Mapping[str, str]) -> str:
    matplotlib: Any = mpl  # its types are not complete
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure: Any = Figure(figsize=SIZE, layout="constrained")
        draw(figure.add_subplot())
        file = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=nothing)
    return _embeddable(file.getvalue(), name, palette)


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
