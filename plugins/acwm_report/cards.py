"""The cards of a leaderboard: what an entry is, how large, trained how, and how it looks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from acwm_core.evaluation.results import VIDEOS, Summary
from acwm_core.evaluation.storage import result_file
from acwm_report.boards import Board, title_of
from acwm_report.entry import MOST_PARAMETERS, Entry
from acwm_report.videos import EmbeddedVideo

STEPS = ("training_steps", "sampling_steps")


@dataclass(frozen=True)
class EntryCard:
    """What a page shows of one entry of a board."""

    key: str  # its id on the page
    title: str
    url: str  # where to read more; "" for nowhere
    facts: Sequence[tuple[str, str]]  # what is known of it, with a heading each
    video: EmbeddedVideo | None  # of its median clip; None if there is none, or no room for it


def entry_facts(name: str, summary: Summary, entry: Entry) -> list[tuple[str, str]]:
    """What is known of an entry, with a heading each."""
    facts, kinds = summary.provenance, ("model", "conditioner", "codec")
    size = facts["parameters"] if entry.parameters is None else entry.parameters
    counts = {"parameters": size, **{n: facts[n] for n in STEPS if not summary.handed_in}}
    for what, count in counts.items():
        if count is not None and not 0 <= count <= MOST_PARAMETERS:
            raise ValueError(f"{what} {count} is not a possible number")
    told = {
        "Model": "" if summary.handed_in else " · ".join(summary.parts[kind] for kind in kinds),
        "Size": "" if size is None else f"{size / 1e6:.3g} M parameters",
        "Data": entry.data,
        "Compute": entry.compute,
    }
    if summary.handed_in:
        lost = "lossless" if facts["coding"] == "lossless" else f"lossy, {facts['coding']}"
        told |= {"Predictions": f"{summary.predictor[:8]}, {lost}"}
    else:
        told |= {
            "Trained": f"{facts['training_steps']:,} steps",
            "Sampling": f"{facts['sampling_steps']} steps",
            "Weights": summary.predictor[:8],
        }
    told["Folder"] = name
    return [(heading, text) for heading, text in told.items() if text]


def cards_of(
    boards: Sequence[Board],
    entries: Mapping[str, Summary],
    about: Mapping[str, Entry],
    folders: Mapping[str, Path],
    megabytes: float,
) -> list[list[EntryCard]]:
    """The cards of each board, in the order of its first table.

    Args:
        about: the card of each entry.
        folders: the folder of each entry's result files.
        megabytes: most megabytes of video on the page; further videos are left out.
    """
    room, found = megabytes * 1e6, list[list[EntryCard]]()
    for board in boards:
        cards: list[EntryCard] = []
        for name in board.names:
            summary, key = entries[name], board.keys[name]
            video = _median_video(f"{key}-video", summary, folders[name], room)
            room -= len(video.data) if video else 0
            facts = entry_facts(name, summary, about[name])
            cards.append(EntryCard(key, title_of(name, summary), about[name].url, facts, video))
        found.append(cards)
    return found


def _median_video(key: str, summary: Summary, folder: Path, room: float) -> EmbeddedVideo | None:
    """The video of the model's median clip of the first split, if it is there and small enough."""
    shown = [each for each in summary.videos if (each.pick, each.kind) == ("median", "model")]
    for record in shown[:1]:
        path = result_file(folder, f"{VIDEOS}/{record.file}")
        if path.is_file() and path.stat().st_size <= room:
            return EmbeddedVideo(key, record, path.read_bytes())
    return None
