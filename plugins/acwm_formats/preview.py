"""Shows what a data folder holds: facts as a dict, a contact sheet, and a video of episodes."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.video import write_mp4
from acwm_core.env.episode import Split
from acwm_core.errors import AcwmWarning, DataError
from acwm_core.files import writable, written_whole

Picture = NDArray[np.uint8]
"""``[H, W, 3]`` uint8; a video has a leading axis T."""

GAP = 6
MIN_SIDE = 144  # pixels; smaller frames are enlarged by repeating pixels
MAX_WIDTH = 2440  # pixels; a wider sheet would show fewer moments
LINE_HEIGHT = 20
INK, ACCENT = (30, 30, 30), (190, 70, 20)
FONT = ImageFont.load_default(size=14)


def describe(path: str | Path) -> dict[str, Any]:
    """Describe the data folder `path`, ready for JSON. It may still be unfinished.

    Returns:
        The card's `environment` (name), `summary`, `frame_size`, `fps`, `horizon`, `seed`,
        `factors`, `versions`, `source` (of recorded data), and `splits`, which has for each split:
        `episodes` (requested), `made`, `shards`, `frames`, `lengths` (shortest and longest),
        `bytes`, `actions` (statistics, once finished) and, for a simulated `ood_test`, the number
        of episodes with each `ood_label`.

    Raises:
        DataError: there is no dataset, or it is damaged.
    """
    path = Path(path)
    card = DatasetCard.read(path)
    values = card.to_dict()
    environment: dict[str, Any] = values["environment"]
    return {
        "path": str(path),
        "environment": environment["name"],
        **{name: environment[name] for name in ("summary", "frame_size", "fps", "horizon")},
        **{name: values[name] for name in ("seed", "factors", "exploration", "versions", "source")},
        "splits": {split: _describe_split(path, card, split) for split in card.splits},
    }


def preview(
    path: str | Path, out: str | Path, *, episodes: int = 4, columns: int = 8
) -> tuple[Path, Path]:
    """Draw the first episodes of every split.

    Args:
        path: the data folder.
        out: folder to write to.
        episodes: number of episodes per split.
        columns: moments of each episode on the contact sheet; fewer for wide frames.

    Returns:
        The paths of ``out/preview.png``, with a row of moments per episode, and of
        ``out/preview.mp4``, in which these episodes play side by side. Both show the split, number
        and shifted factor of each episode.

    Raises:
        DataError: there is no dataset, it is unfinished, none of the episodes can be read, or `out`
            cannot be written.
    """
    out = writable(Path(out), folder=True)
    card = DatasetCard.read(path)
    labels: list[Label] = []
    videos: list[NDArray[np.uint8]] = []
    for split in card.splits:
        dataset = EpisodeDataset(path, split)
        for index in range(min(episodes, len(dataset))):
            if why := dataset.damage(index):
                left = f"episode {index} of {split} is left out: {why}"
                warnings.warn(left, AcwmWarning, stacklevel=2)
                continue
            shifted = cast(str | None, dataset.about(index)["ood_label"])
            labels.append(Label(f"{split} {index}", shifted or ""))
            videos.append(dataset.video(index).transpose(0, 2, 3, 1))
    if not videos:
        raise DataError(f"none of the first episodes of {path} can be read: run `acwm data check`")
    out.mkdir(parents=True, exist_ok=True)
    sheet, video = out / "preview.png", out / "preview.mp4"
    with written_whole(sheet) as partial:
        Image.fromarray(contact_sheet(labels, videos, columns)).save(partial, "png")
    write_mp4(video, play_together(labels, videos), fps=card.environment.fps)
    return sheet, video


def _describe_split(path: Path, card: DatasetCard, split: Split) -> dict[str, Any]:
    records = Manifest(path / split, card.splits[split]).ordered()
    lengths = [length for record in records for length in record.lengths]
    facts: dict[str, Any] = {
        "episodes": card.splits[split],
        "made": sum(record.episodes for record in records),
        "shards": len(records),
        "frames": sum(lengths),
        "lengths": [min(lengths), max(lengths)] if lengths else [],
        "bytes": sum(record.size for record in records),
        "actions": dict(card.actions.get(split, {})),
    }
    whole = facts["made"] == facts["episodes"]
    if not card.source and split == "ood_test" and whole:  # recorded shifts are not labelled
        dataset = EpisodeDataset(path, split)
        labels = Counter(_label(dataset, index) for index in range(len(dataset)))
        facts["ood_labels"] = dict(sorted(labels.items()))
    return facts


def _label(dataset: EpisodeDataset, index: int) -> str:
    try:
        return dataset.about(index)["ood_label"] or "none"
    except DataError:
        return "nothing that can be read"


class Label(NamedTuple):
    """The text above a picture: the episode and, in another colour, a remark."""

    name: str
    remark: str = ""


def contact_sheet(labels: Sequence[Label], videos: Sequence[Picture], columns: int = 8) -> Picture:
    """Draw a row of evenly spaced moments of each video ``[T, H, W, 3]``, below its label.

    Args:
        labels: one label per video.
        videos: videos of equal frame size; the moments include the first and the last frame.
        columns: moments of each video; fewer if they do not fit into `MAX_WIDTH` pixels.
    """
    width = magnified(videos[0][0]).shape[1]
    columns = max(2, min(columns, (MAX_WIDTH + GAP) // (width + GAP)))
    rows: list[Picture] = []
    for label, video in zip(labels, videos, strict=True):
        moments = np.linspace(0, len(video) - 1, min(columns, len(video))).round().astype(int)
        row = beside([magnified(video[t]) for t in moments])
        rows.append(below([_strip(_wrapped(label, row.shape[1]), row.shape[1]), row], gap=0))
    return below(rows)


def play_together(
    labels: Sequence[Label], videos: Sequence[Picture], across: int | None = None
) -> Iterator[Picture]:
    """Frames that show all videos, of equal size, below their labels; `across` videos per row."""
    width = magnified(videos[0][0]).shape[1]
    texts = [_wrapped(label, width) for label in labels]
    most = max(len(lines) for lines in texts)
    strips = [_strip([*[[]] * (most - len(lines)), *lines], width) for lines in texts]
    across = across or math.ceil(math.sqrt(len(videos)))
    for t in range(max(len(video) for video in videos)):
        cells = [
            below([strip, magnified(video[min(t, len(video) - 1)])], gap=0)
            for strip, video in zip(strips, videos, strict=True)
        ]
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % across)
        yield below([beside(cells[at : at + across]) for at in range(0, len(cells), across)])


def magnified(frame: Picture) -> Picture:
    """Enlarge a small frame by drawing each pixel several times."""
    scale = math.ceil(MIN_SIDE / min(frame.shape[:2]))
    return frame.repeat(scale, axis=0).repeat(scale, axis=1)


def beside(pictures: Sequence[Picture]) -> Picture:
    """Pictures of equal height in a row."""
    padded = [np.pad(each, ((0, 0), (0, GAP), (0, 0)), constant_values=255) for each in pictures]
    return np.concatenate(padded, axis=1)[:, :-GAP]


def below(pictures: Sequence[Picture], gap: int = GAP) -> Picture:
    """Pictures in a column, the narrower ones filled up on the right."""
    width = max(picture.shape[1] for picture in pictures)
    padded = [
        np.pad(each, ((0, gap), (0, width - each.shape[1]), (0, 0)), constant_values=255)
        for each in pictures
    ]
    return np.concatenate(padded)[: -gap or None]


TextLine = list[tuple[str, tuple[int, int, int]]]
"""Pieces of text with their colours."""


def _wrapped(label: Label, width: int) -> list[TextLine]:
    room, lines = width - 4, [[(label.name, INK)]]
    for number, part in enumerate(label.remark.replace("+", " +").split()):
        joined = part if part.startswith("+") else (" " if number else "   ") + part
        if FONT.getlength("".join(text for text, _ in lines[-1]) + joined) <= room:
            lines[-1].append((joined, ACCENT))
            continue
        while FONT.getlength(part) > room:
            part = part.removesuffix("…")[:-1] + "…"
        lines.append([(part, ACCENT)])
    return lines


def _strip(lines: Sequence[TextLine], width: int) -> Picture:
    image = Image.new("RGB", (width, LINE_HEIGHT * len(lines)), "white")
    pen = ImageDraw.Draw(image)
    for row, line in enumerate(lines):
        x = 2.0
        for text, colour in line:
            pen.text((x, row * LINE_HEIGHT + 1), text, fill=colour, font=FONT)
            x += FONT.getlength(text)
    return np.asarray(image)
