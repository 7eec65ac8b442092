"""`write_leaderboard`: the result files of many runs on one page, grouped by equal test setup."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.files import regular_file, writable
from acwm_planning.results import PLANS
from acwm_report.boards import boards_of
from acwm_report.cards import cards_of, entry_facts
from acwm_report.entry import Entry, entry_of
from acwm_report.page import write_page
from acwm_report.run import DAMAGE, described
from acwm_report.uses import Use, uses_of
from acwm_report.videos import MEGABYTES


@dataclass
class Collection:
    """The results found below a folder."""

    # readable results without duplicates, keyed by their run folder relative to the folder
    entries: dict[str, Summary] = field(default_factory=dict[str, Summary])
    about: dict[str, Entry] = field(default_factory=dict[str, Entry])  # the card of each entry
    folders: dict[str, Path] = field(default_factory=dict[str, Path])  # where its result lies
    uses: list[Use] = field(default_factory=list[Use])  # how useful the models in `entries` are
    broken: dict[str, str] = field(default_factory=dict[str, str])  # unreadable files, and why
    copies: int = 0  # number of files that are byte-identical to another


def write_leaderboard(
    folder: str | Path, out: str | Path | None = None, *, megabytes: float = MEGABYTES
) -> tuple[Path, Collection]:
    """Collect the result files below a folder into one page.

    Runs share a table only if they have the same environment, test data and protocol. The page
    names files that are damaged or come from another version of acwm.

    Args:
        out: the ``.html`` to write; ``leaderboard.html`` in the folder by default.
        megabytes: most megabytes of video to embed, one of each entry.

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
    out = writable(Path(out) if out else folder / "leaderboard.html", option="--out")
    boards = boards_of(found.entries, found.uses)
    cards = cards_of(boards, found.entries, found.about, found.folders, megabytes)
    return write_page(
        out,
        "leaderboard.html.j2",
        found=found,
        boards=list(zip(boards, cards, strict=True)),
        capabilities=list(dict.fromkeys(name for board in boards for name in board.tables)),
    ), found


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
            digest = file_sha256(regular_file(folder, file))
            if digest in seen:
                found.copies += 1
                continue
            summary = Summary.load(path)
            summary = replace(summary, metrics=described(summary.metrics))
            entry = entry_of(run, summary)
            boards_of({name: summary})  # old files may lack what they need
            entry_facts(name, summary, entry)
        except KeyError as error:
            found.broken[file] = f"{error} is missing"
        except DAMAGE as error:
            found.broken[file] = str(error).removeprefix(f"{path} ").removeprefix("is ")
        else:
            seen.add(digest)
            label = file if name in found.entries else name  # a run folder may hold two files
            found.entries[label] = summary
            found.about[label], found.folders[label] = entry, path.parent
            _add_uses(found, label, run, summary)
    return found


def _add_uses(found: Collection, label: str, run: Path, summary: Summary) -> None:
    """Add how well a model ranks and plans; a damaged file is reported, but its run stays."""
    try:
        found.uses += uses_of(label, run, summary)
    except DAMAGE as error:
        found.broken[f"{label}: rankings and plans"] = str(error)
