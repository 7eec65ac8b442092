"""`write_leaderboard`: the result files of many runs on one page, like beside like."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from acwm_core.data.atomic import writable, written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.report.likeness import checksums, protocol_of
from acwm_core.report.main_table import METRICS, SCALES, SPLITS, score_cell
from acwm_core.report.page import templates
from acwm_core.report.table import Cell, Column, Row, Table
from acwm_core.report.tables import clips_title
from acwm_core.report.wording import Scale, metric_title, split_title

PAGE = "leaderboard.html"


@dataclass(frozen=True)
class Entry:
    """A result file.

    Attributes:
        name: its run folder, relative to the folder that was searched.
        summary: what it holds.
    """

    name: str
    summary: Summary


@dataclass(frozen=True)
class Board:
    """Runs that predicted the same clips.

    Attributes:
        environment: registered name.
        protocol: with all that decides which clips are predicted.
        data: the beginnings of the test data's hashes.
        table: one line per run, the best first.
    """

    environment: str
    protocol: str
    data: str
    table: Table


@dataclass(frozen=True)
class Collection:
    """What was found in a folder.

    Attributes:
        entries: results that can be read, each once.
        broken: files that cannot, and why.
        copies: how many files hold the same bytes as another.
    """

    entries: list[Entry]
    broken: dict[str, str]
    copies: int


def write_leaderboard(folder: str | Path, out: str | Path | None = None) -> tuple[Path, Collection]:
    """Collect the result files below a folder into one page.

    Runs stand in one table only if they are of one environment, test data and protocol. Files that
    are damaged or of another version of acwm are named on the page.

    Args:
        folder: searched for ``summary.json`` at any depth.
        out: the ``.html`` to write; ``leaderboard.html`` in the folder by default.

    Returns:
        The file, and what it holds.

    Raises:
        DataError: there is no such folder, nothing in it, or `out` cannot be written.
    """
    folder = Path(folder)
    found = collect(folder)
    if not found.entries:
        broken = "; ".join(f"{name}: {why}" for name, why in found.broken.items())
        reason = f" that can be read ({broken})" if broken else ""
        raise DataError(f"{folder} holds no results{reason}: run `acwm evaluate` on runs in it")
    out = writable(Path(out) if out else folder / PAGE)
    out.parent.mkdir(parents=True, exist_ok=True)
    boards = boards_of(found.entries)
    html = templates().get_template("leaderboard.html.j2").render(found=found, boards=boards)
    with written_whole(out) as partial:
        partial.write_text(html, encoding="utf-8")
    return out, found


def collect(folder: Path) -> Collection:
    """Read every result file below a folder, in order of their paths.

    Raises:
        DataError: there is no such folder.
    """
    if not folder.is_dir():
        raise DataError(f"there is no folder {folder}")
    entries: list[Entry] = []
    broken: dict[str, str] = {}
    seen: set[str] = set()
    copies = 0
    for path in sorted(folder.rglob(SUMMARY)):
        name = _name(path, folder)
        try:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            if digest in seen:
                copies += 1
                continue
            entry = Entry(name, Summary.load(path))
            _table([entry], _clips(entry.summary)[0])  # old files may lack what it needs
        except (DataError, OSError, KeyError, TypeError) as error:
            broken[str(path.relative_to(folder))] = _reason(error)
            continue
        seen.add(digest)
        entries.append(entry)
    return Collection(entries, broken, copies)


def boards_of(entries: Sequence[Entry]) -> list[Board]:
    """Tables of runs that predicted the same clips, by environment, protocol and data."""
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for entry in entries:
        groups.setdefault(_clips(entry.summary), []).append(entry)
    boards: list[Board] = []
    for number, (_, group) in enumerate(sorted(groups.items())):
        summary = group[0].summary
        hashes = ", ".join(
            f"{split} {checksums(summary)[split][:8]}"
            for split in summary.splits
            if split in checksums(summary)
        )
        table = _table(group, f"board-{number}")
        boards.append(Board(summary.parts["env"], protocol_of(summary), hashes, table))
    return boards


def _clips(summary: Summary) -> tuple[str, ...]:
    """What two results must share to stand in one table."""
    splits = [
        f"{split} {checksums(summary).get(split, '')} {each.scores.clips} {each.scores.episodes}"
        for split, each in summary.splits.items()
    ]
    return summary.parts["env"], protocol_of(summary), *splits


def _table(entries: Sequence[Entry], name: str) -> Table:
    first = entries[0].summary
    splits = [split for split in (*SPLITS, *first.splits) if split in first.splits]
    splits = list(dict.fromkeys(splits))
    names = [m for m in METRICS if any(m in each.summary.metrics for each in entries)]
    names = names or [first.headline]
    columns = [
        Column(
            metric_title(metric),
            (SCALES.get(metric) or Scale.of([], first.metrics[metric].unit)).unit,
            "↑" if first.metrics[metric].higher_is_better else "↓",
            group=split_title(split),
            key=f"{split}_{metric}",
        )
        for split in splits
        for metric in names
        if metric in first.metrics
    ]
    facts = ("Model", "Parameters", "Trained", "Sampling", "Weights")
    columns += [Column(title) for title in facts]
    ranked = sorted(entries, key=_rank)
    rows = [_row(entry, splits, [m for m in names if m in first.metrics]) for entry in ranked]
    title = ", ".join(
        f"{split_title(split)}: {clips_title(each.scores)}" for split, each in first.splits.items()
    )
    return Table(title, columns, rows, "Run", name=name)


def _row(entry: Entry, splits: Sequence[str], names: Sequence[str]) -> Row:
    scores = {split: each.scores.rows["model"] for split, each in entry.summary.splits.items()}
    cells = [
        score_cell(scores, split, name, entry.summary.metrics) for split in splits for name in names
    ]
    return Row(entry.name, "", "", [*cells, *_facts(entry)])


def _facts(entry: Entry) -> list[Cell]:
    """What was trained, how long, and sampled in how many steps."""
    facts, parts = entry.summary.provenance, entry.summary.parts
    names = " · ".join(parts[part] for part in ("model", "conditioner", "codec"))
    millions = facts["parameters"] / 1e6
    return [
        Cell(names),
        Cell(f"{millions:.1f} M", value=facts["parameters"]),
        Cell(f"{facts['training_steps']:,} steps", value=facts["training_steps"]),
        Cell(f"{facts['sampling_steps']} steps", value=facts["sampling_steps"]),
        Cell(facts["weights_sha256"][:8]),
    ]


def _rank(entry: Entry) -> tuple[float, str]:
    """The best in distribution first."""
    summary = entry.summary
    split = next(iter(summary.splits))
    value = summary.splits[split].scores.rows["model"][summary.headline].value
    if value is None:
        return float("inf"), entry.name
    return -value if summary.metrics[summary.headline].higher_is_better else value, entry.name


def _name(path: Path, folder: Path) -> str:
    """The run folder of a result file, as the page calls it."""
    run = path.parent.parent if path.parent.name == FOLDER else path.parent
    try:
        return str(run.relative_to(folder)) if run != folder else folder.resolve().name
    except ValueError:
        return folder.resolve().name


def _reason(error: Exception) -> str:
    """Why a result file cannot be read, without its path."""
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error).partition(" is ")[2] or str(error)
