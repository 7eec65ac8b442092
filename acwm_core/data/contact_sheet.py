"""Labelled pictures of episodes: moments side by side, and films that play together."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Picture = NDArray[np.uint8]
"""``[H, W, 3]`` uint8; a film has a T in front."""

GAP = 6
SMALLEST = 144  # pixels: smaller frames are shown enlarged, each pixel several times
WIDEST = 2440  # pixels: a sheet that would be wider shows fewer moments
LINE_HEIGHT = 20
BACKGROUND, INK, ACCENT = (255, 255, 255), (30, 30, 30), (190, 70, 20)


class Label(NamedTuple):
    """What stands above a picture: which episode it is and, set off by colour, what is special."""

    name: str
    remark: str = ""


def contact_sheet(labels: Sequence[Label], films: Sequence[Picture], columns: int = 8) -> Picture:
    """A row of evenly spaced moments of each film ``[T, H, W, 3]``, under its label.

    Args:
        labels: one per film.
        films: of one frame size; the first and the last frame are among the moments.
        columns: moments of each; fewer where they would not fit into `WIDEST` pixels.
    """
    width = magnified(films[0][0]).shape[1]
    columns = max(2, min(columns, (WIDEST + GAP) // (width + GAP)))
    rows: list[Picture] = []
    for label, film in zip(labels, films, strict=True):
        moments = np.linspace(0, len(film) - 1, min(columns, len(film))).round().astype(int)
        row = beside([magnified(film[t]) for t in moments])
        rows.append(below([_strip(_wrapped(label, row.shape[1]), row.shape[1]), row], gap=0))
    return below(rows)


def play_together(
    labels: Sequence[Label], films: Sequence[Picture], across: int | None = None
) -> Iterator[Picture]:
    """Frame by frame, all films in a grid under their labels.

    Args:
        labels: one per film.
        films: of one frame size; the shorter ones rest on their last frame.
        across: films in a row; by default as many as make the grid nearly square.
    """
    width = magnified(films[0][0]).shape[1]
    texts = [_wrapped(label, width) for label in labels]
    most = max(len(lines) for lines in texts)
    strips = [_strip([*[[]] * (most - len(lines)), *lines], width) for lines in texts]
    across = across or math.ceil(math.sqrt(len(films)))
    for t in range(max(len(film) for film in films)):
        cells = [
            below([strip, magnified(film[min(t, len(film) - 1)])], gap=0)
            for strip, film in zip(strips, films, strict=True)
        ]
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % across)
        yield below([beside(cells[at : at + across]) for at in range(0, len(cells), across)])


def magnified(frame: Picture) -> Picture:
    """A frame, or if it is small, one with each pixel drawn several times."""
    scale = math.ceil(SMALLEST / min(frame.shape[:2]))
    return frame.repeat(scale, axis=0).repeat(scale, axis=1)


def beside(pictures: Sequence[Picture], gap: int = GAP) -> Picture:
    """Pictures of equal height in a row."""
    bar = np.full((len(pictures[0]), gap, 3), BACKGROUND, np.uint8)
    return np.concatenate([part for picture in pictures for part in (bar, picture)][1:], axis=1)


def below(pictures: Sequence[Picture], gap: int = GAP) -> Picture:
    """Pictures in a column, the narrower ones filled up on the right."""
    width = max(picture.shape[1] for picture in pictures)
    bar, parts = np.full((gap, width, 3), BACKGROUND, np.uint8), list[Picture]()
    for picture in pictures:
        blank = np.full((len(picture), width - picture.shape[1], 3), BACKGROUND, np.uint8)
        parts += [bar, np.concatenate([picture, blank], axis=1)]
    return np.concatenate(parts[1:])


Line = list[tuple[str, tuple[int, int, int]]]
"""Pieces of text with their colours."""


@functools.cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=14)


def _length(text: str) -> float:
    return cast(float, _font().getlength(text))


def _wrapped(label: Label, width: int) -> list[Line]:
    """The label on one line, or broken where its parts meet, each part cut to `width`."""
    room, line = width - 4, label.name
    pieces = [(label.name, INK)]
    lines: list[Line] = []
    for number, part in enumerate(label.remark.replace("+", " +").split()):
        joined = part if part.startswith("+") else (" " if number else "   ") + part
        if pieces and _length(line + joined) <= room:
            pieces.append((joined, ACCENT))
            line += joined
        else:
            lines.append(pieces)
            line = _cut(part, room)
            pieces = [(line, ACCENT)]
    return [*lines, pieces]


def _cut(text: str, room: float) -> str:
    """`text`, or as much of its beginning as fits, with an ellipsis."""
    if _length(text) <= room:
        return text
    while text and _length(text + "…") > room:
        text = text[:-1]
    return text + "…"


def _strip(lines: Sequence[Line], width: int) -> Picture:
    """Lines of text on the background, `width` pixels wide."""
    image = Image.new("RGB", (width, LINE_HEIGHT * len(lines)), BACKGROUND)
    pen = ImageDraw.Draw(image)
    for row, line in enumerate(lines):
        x = 2.0
        for text, colour in line:
            pen.text((x, row * LINE_HEIGHT + 1), text, fill=colour, font=_font())
            x += _length(text)
    return np.asarray(image)
