"""`write_data_report`: the report of a dataset, as one HTML file."""

from __future__ import annotations

import base64
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.video import write_mp4
from acwm_formats.survey.actions import ActionSummary
from acwm_formats.survey.sample import all_places, spread
from acwm_formats.survey.survey import PHRASES, Survey
from acwm_report.figures import Chart, Curve
from acwm_report.page import write_page
from acwm_report.table import MISSING, Cell, Column, Row, Table

SHOWN = 6  # sample videos
FRAMES = 150  # of each, at most
SIDE = 160  # pixels; smaller frames are enlarged
BARS = 24  # of the histogram of lengths


@dataclass(frozen=True)
class Sample:
    """An episode to look at."""

    title: str  # its split and number
    about: str  # its length
    actions: list[list[float]]  # of the frames shown
    base64: Markup  # an MP4 file


def write_data_report(found: Survey, out: str | Path) -> Path:
    """Write the page about a dataset that was surveyed.

    Returns:
        The path of the file.

    Raises:
        DataError: the dataset is damaged, or `out` cannot be written.
    """
    return write_page(
        Path(out),
        "data.html.j2",
        found=found,
        card=found.card,
        samples=_samples(found),
        delay_chart=_delay_chart(found),
        action_table=_action_table(found),
        histograms=[_histogram(each) for each in found.actions if not each.constant],
        length_charts=_length_charts(found),
        frame_table=_frame_table(found),
        needs=needs_table(),
    )


def _samples(found: Survey) -> list[Sample]:
    places = [each for each in all_places(found.lengths) if each not in found.unread.places]
    samples: list[Sample] = []
    for place in spread(len(places), SHOWN):
        split, index = places[place]
        data, length = EpisodeDataset(found.path, split), found.lengths[split][index]
        video = data.video(index, 0, min(length, FRAMES)).transpose(0, 2, 3, 1)
        file = io.BytesIO()
        write_mp4(file, video, found.card.environment.fps, scale=-(-SIDE // min(video.shape[1:3])))
        cut = f", the first {len(video)} shown" if length > len(video) else ""
        actions = data.actions(index)[: len(video)].tolist()
        code = Markup(base64.b64encode(file.getvalue()).decode())
        samples.append(Sample(f"{split} {index}", f"{length} frames{cut}", actions, code))
    return samples


def _delay_chart(found: Survey) -> Chart | None:
    seen = found.following
    if seen is None:
        return None
    ticks = [(float(shift), f"{shift:+d}" if shift else "0") for shift in seen.shifts]
    shares = [100 * share for share in seen.explained]
    curve = Curve("", "model", list(map(float, seen.shifts)), shares)
    shaded = None if seen.delay is None else (seen.delay - 0.3, seen.delay + 0.3)
    return Chart(
        "New information about the action, by delay",
        "delay",
        [curve],
        "frames from the action to the change",
        "% of the information",
        points=True,
        ticks=ticks,
        shaded=shaded,
    )


def _action_table(found: Survey) -> Table:
    columns = [Column(each) for each in ("Bounds", "Range", "98 % within", "Mean", "SD", "Read")]
    read = found.following.read if found.following else [float("nan")] * len(found.actions)
    rows = [
        Row(
            each.name.replace("_", " "),
            [
                Cell(f"{each.bounds[0]:.4g} to {each.bounds[1]:.4g}"),
                Cell(f"{each.least:.4g} to {each.most:.4g}"),
                Cell(f"{each.quantiles[0]:.4g} to {each.quantiles[1]:.4g}"),
                Cell(f"{each.mean:.3g}"),
                Cell(f"{each.std:.3g}"),
                Cell(MISSING if np.isnan(share) else f"{share:.0%}"),
            ],
            note=each.unit if not each.constant else "constant",
            muted=each.constant,
        )
        for each, share in zip(found.actions, read, strict=True)
    ]
    says = (
        "Models normalise actions by the bounds. Read: the share of an action’s variance that its "
        "frames explain; a low value means that the action is hard to learn."
    )
    return Table("", columns, rows, "Action", says, "actions")


def _histogram(each: ActionSummary) -> Chart:
    edges, total = each.edges, max(sum(each.counts), 1)
    x = [edge for pair in itertools.pairwise(edges) for edge in pair]
    y = [100 * count / total for count in each.counts for _ in range(2)]
    curve = Curve("", "model", x, y, low=[0.0] * len(y), high=y)
    title, unit = each.name.replace("_", " "), f" ({each.unit})" if each.unit else ""
    return Chart(title, f"action-{each.name}", [curve], f"{title}{unit}", "% of the frames")


def _length_charts(found: Survey) -> list[Chart]:
    lengths = [length for each in found.lengths.values() for length in each]
    if min(lengths) == max(lengths):
        return []
    counts, edges = np.histogram(lengths, BARS)
    x = [float(edge) for pair in itertools.pairwise(edges) for edge in pair]
    y = [float(count) for count in counts for _ in range(2)]
    curve = Curve("", "model", x, y, low=[0.0] * len(y), high=y)
    return [Chart("Lengths of the episodes", "lengths", [curve], "frames", "episodes")]


def _frame_table(found: Survey) -> Table:
    facts = found.frames
    rows: list[Row] = []
    for name, phrase in PHRASES.items():
        places = [f"{split} {e}, frame {t}" for split, e, t in facts.examples.get(name, ())]
        count = getattr(facts, name)
        share = f"{count / max(facts.frames, 1):.2%}"
        rows.append(
            Row(phrase, [Cell(str(count)), Cell(share), Cell("; ".join(places) or MISSING)])
        )
    columns = [Column("Frames"), Column("Share"), Column("Examples")]
    return Table("", columns, rows, "Frames that are", "", "frames")


def needs_table() -> Table:
    """Scores of `small` by amount of data.

    It is read from ``needs.yaml``, a list of rows with `world`, `episodes`, `psnr` (dB) and
    `response`, and optionally the same two from a shipped model as a start, `psnr_started` and
    `response_started`.
    """
    text = resources.files("acwm_report").joinpath("needs.yaml").read_text("utf-8")
    measured: Sequence[dict[str, Any]] = yaml.safe_load(text)["rows"]
    names = ("psnr", "response", "psnr_started", "response_started")
    found = {
        (row["episodes"], row["world"], name): f"{row[name]:.2f}"
        for row in measured
        for name in names
        if name in row
    }
    places = [
        (world, name)
        for world in dict.fromkeys(row["world"] for row in measured)
        for name in names
        if any(key[1:] == (world, name) for key in found)
    ]
    columns: list[Column] = []
    for world, name in places:
        key, _, started = name.partition("_")
        title, unit = ("PSNR", "dB") if key == "psnr" else ("Response", "")
        columns.append(Column(f"{title}, {started}" if started else title, unit, "↑", world))
    rows = [
        Row(f"{count:,}", [Cell(found.get((count, *place), MISSING)) for place in places])
        for count in sorted({row["episodes"] for row in measured})
    ]
    return Table("", columns, rows, "Episodes", "", "needs")
