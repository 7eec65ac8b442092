"""`write_leaderboard`: the result files of many runs on one page, grouped by equal test setup."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.files import inside
from acwm_planning.jobs import PLANS
from acwm_report.comparison import checksums
from acwm_report.draws import draws_phrase
from acwm_report.page import write_page
from acwm_report.run import DAMAGE, described
from acwm_report.scores import (
    ScoreGrid,
    compared_metrics,
    failures,
    model_scores,
    scored_shares,
)
from acwm_report.table import Cell, Column, Row, Table
from acwm_report.titles import clips_title, split_title
from acwm_report.uses import Use, use_table, uses_of


@dataclass(frozen=True)
class Board:
    """The runs that predicted the same clips."""

    environment: str  # registered name
    protocol: str  # with the settings that decide which clips are predicted
    data: str  # the first characters of the test data's hashes
    table: Table  # one row per run, the best first
    uses: Table | None = None  # how well they rank policies and plan; None if none was tried


@dataclass
class Collection:
    """The results found below a folder."""

    # readable results without duplicates, keyed by their run folder relative to the folder
    entries: dict[str, Summary] = field(default_factory=dict[str, Summary])
    uses: list[Use] = field(default_factory=list[Use])  # how useful the models in `entries` are
    broken: dict[str, str] = field(default_factory=dict[str, str])  # unreadable files, and why
    copies: int = 0  # number of files that are byte-identical to another


def write_leaderboard(folder: str | Path, out: str | Path | None = None) -> tuple[Path, Collection]:
    """Collect the result files below a folder into one page.

    Runs share a table only if they have the same environment, test data and protocol. The page
    names files that are damaged or come from another version of acwm.

    Args:
        out: the ``.html`` to write; ``leaderboard.html`` in the folder by default.

    Returns:
        The path of the page, and the results on it.

    Raises:
        DataError: the folder does not exist or holds no results, or `out` cannot be written.
    """
    folder = Path(folder)
    found = collect(folder)
    if not found.entries:
        broken = "; ".join(f"{name}: {why}" for name, why in found.broken.items())
        reason = f" that can be read ({broken})" if broken else ""
        raise DataError(f"{folder} holds no results{reason}: run `acwm evaluate` on runs in it")
    out = Path(out) if out else folder / "leaderboard.html"
    boards = boards_of(found.entries, found.uses)
    return write_page(out, "leaderboard.html.j2", found=found, boards=boards), found


def collect(folder: Path) -> Collection:
    """Read every result file below a folder, sorted by path.

    Raises:
        DataError: the folder does not exist.
    """
    if not folder.is_dir():
        raise DataError(f"there is no folder {folder}")
    found, seen = Collection(), set[str]()
    for path in sorted(folder.rglob(SUMMARY)):
        if path.parts[-3] == PLANS:  # a table of plans; it is read with its run
            continue
        file = str(path.relative_to(folder))
        run = path.parent.parent if path.parent.name == FOLDER else path.parent
        below = run != folder and run.is_relative_to(folder)
        name = str(run.relative_to(folder)) if below else folder.resolve().name
        try:
            digest = file_sha256(inside(folder, file))
            if digest in seen:
                found.copies += 1
                continue
            summary = Summary.load(path)
            summary = replace(summary, metrics=described(summary.metrics))
            boards_of({name: summary})  # old files may lack what it needs
        except KeyError as error:
            found.broken[file] = f"it lacks {error}"
        except DAMAGE as error:
            found.broken[file] = str(error).removeprefix(f"{path} ").removeprefix("is ")
        else:
            seen.add(digest)
            label = file if name in found.entries else name  # a run folder may hold two files
            found.entries[label] = summary
            _add_uses(found, label, run, summary)
    return found


def _add_uses(found: Collection, label: str, run: Path, summary: Summary) -> None:
    """Add how well a model ranks and plans; a damaged file is reported, but its run stays."""
    try:
        found.uses += uses_of(label, run, summary)
    except DAMAGE as error:
        found.broken[f"{label}: rankings and plans"] = str(error)


def boards_of(entries: Mapping[str, Summary], uses: Sequence[Use] = ()) -> list[Board]:
    """Group runs that predicted the same clips (same environment, protocol and data) in tables."""
    groups: dict[tuple[str, ...], dict[str, Summary]] = {}
    for name, summary in entries.items():
        hashes = checksums(summary)
        clips = [
            f"{split} {hashes.get(split, '')} {each.scores.clips} {each.scores.episodes}"
            for split, each in summary.splits.items()
        ]
        place = summary.parts["env"], _protocol(summary), *clips
        groups.setdefault(place, {})[name] = summary
    boards: list[Board] = []
    for number, place in enumerate(sorted(groups)):
        summary = next(iter(groups[place].values()))
        hashes = {s: h for s, h in checksums(summary).items() if s in summary.splits}
        data = ", ".join(f"{split} {hashed[:8]}" for split, hashed in hashes.items())
        table = _table(groups[place], f"board-{number}")
        names = [row.title for row in table.rows]
        own = use_table([use for use in uses if use.run in names], names, f"uses-{number}")
        boards.append(Board(summary.parts["env"], _protocol(summary), data, table, own))
    return boards


def _protocol(summary: Summary) -> str:
    chosen = summary.provenance["evaluation"]
    names = [each for each in ("frames", "cuts", "episodes") if chosen.get(each) is not None]
    return ", ".join([summary.protocol, *(f"{chosen[name]} {name}" for name in names)])


def _table(entries: Mapping[str, Summary], name: str) -> Table:
    ranked = dict(sorted(entries.items(), key=lambda item: (_place(item[1]), item[0])))
    summaries = list(ranked.values())
    first, models = summaries[0], list(map(model_scores, summaries))
    metrics = compared_metrics(summaries) or {first.headline: first.metrics[first.headline]}
    grid = ScoreGrid.of(models, metrics)
    facts = ("Model", "Parameters", "Trained", "Sampling", "Weights")
    rows = [
        Row(name, [*grid.cells(scores), *_facts(summary)], ", ".join(_remarks(summary, metrics)))
        for (name, summary), scores in zip(ranked.items(), models, strict=True)
    ]
    clips = [f"{split_title(s)}: {clips_title(each.scores)}" for s, each in first.splits.items()]
    return Table(", ".join(clips), [*grid.columns(), *map(Column, facts)], rows, "Run", name=name)


def _remarks(summary: Summary, metrics: Iterable[str]) -> list[str]:
    drawn = {split: draws_phrase(summary, split) for split in summary.splits}
    found = [f"{split_title(split)}: {phrase}" for split, phrase in drawn.items() if phrase]
    return [*failures(summary), *scored_shares(summary, metrics), *found]


def _facts(summary: Summary) -> list[Cell]:
    facts, names = summary.provenance, ("model", "conditioner", "codec")
    return [
        Cell(" · ".join(summary.parts[name] for name in names)),
        Cell(f"{facts['parameters'] / 1e6:.1f} M", value=facts["parameters"]),
        Cell(f"{facts['training_steps']:,} steps", value=facts["training_steps"]),
        Cell(f"{facts['sampling_steps']} steps", value=facts["sampling_steps"]),
        Cell(facts["weights_sha256"][:8]),
    ]


def _place(summary: Summary) -> float:
    """Sort key: the model's headline score in the first split; lower is better."""
    value = next(iter(summary.splits.values())).scores.rows["model"][summary.headline].value
    sign = -1 if summary.metrics[summary.headline].higher_is_better else 1
    return float("inf") if value is None else sign * value
