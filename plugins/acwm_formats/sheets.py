"""Draws videos as contact sheets and as films that play together, with masks and actions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acwm_core.data.pictures import Picture, enlarge, join, moments
from acwm_core.env.card import ActionSpec

GAP = 6
MIN_SIDE = 144  # pixels; smaller frames are enlarged by repeating pixels
MAX_WIDTH = 2440  # pixels; a wider sheet would show fewer moments
LINE_HEIGHT = 20
INK, ACCENT, PALE = (30, 30, 30), (190, 70, 20), (222, 222, 218)
COLOURS = (
    *((36, 80, 216), (194, 86, 12), (11, 125, 99), (155, 47, 174)),
    *((138, 109, 0), (192, 40, 92), (11, 120, 150), (122, 74, 33)),
)
"""Colours of action dimensions and of instances; after the last one the first comes again."""

CURVES = 56  # pixels; height of the curves of actions
FONT = ImageFont.load_default(size=14)


class Label(NamedTuple):
    """The text above a picture: the episode and, in another colour, a remark."""

    name: str
    remark: str = ""


def contact_sheet(
    labels: Sequence[Label],
    videos: Sequence[Picture],
    columns: int = 8,
    curves: Sequence[NDArray[np.floating]] = (),
) -> Picture:
    """Draw a row of evenly spaced moments of each video ``[T, H, W, 3]``, below its label.

    Args:
        labels: one label per video.
        videos: videos of equal frame size; the moments include the first and the last frame.
        columns: moments of each video; fewer if they do not fit into `MAX_WIDTH` pixels.
        curves: the `action_shares` of each video, drawn below its moments; none by default.
    """
    width = magnified(videos[0][0]).shape[1]
    columns = max(2, min(columns, (MAX_WIDTH + GAP) // (width + GAP)))
    rows: list[Picture] = []
    for number, (label, video) in enumerate(zip(labels, videos, strict=True)):
        row = join([magnified(video[t]) for t in moments(len(video), columns)], gap=GAP)
        parts = [_strip(_wrapped(label, row.shape[1]), row.shape[1]), row]
        parts += [draw_curves(shares, row.shape[1]) for shares in curves[number : number + 1]]
        rows.append(join(parts, down=True))
    return join(rows, down=True, gap=GAP)


def play_together(
    labels: Sequence[Label],
    videos: Sequence[Picture],
    across: int | None = None,
    curves: Sequence[NDArray[np.floating]] = (),
) -> Iterator[Picture]:
    """Frames that show all videos, of equal size, below their labels; `across` videos per row.

    Below each video are the curves of its `action_shares`, if they are given.
    """
    width = magnified(videos[0][0]).shape[1]
    texts = [_wrapped(label, width) for label in labels]
    most = max(len(lines) for lines in texts)
    strips = [_strip([*[[]] * (most - len(lines)), *lines], width) for lines in texts]
    across = across or math.ceil(math.sqrt(len(videos)))
    for t in range(max(len(video) for video in videos)):
        cells: list[Picture] = []
        for number, (strip, video) in enumerate(zip(strips, videos, strict=True)):
            now = min(t, len(video) - 1)
            parts = [strip, magnified(video[now])]
            parts += [draw_curves(shares, width, now) for shares in curves[number : number + 1]]
            cells.append(join(parts, down=True))
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % across)
        rows = (cells[first : first + across] for first in range(0, len(cells), across))
        yield join([join(row, gap=GAP) for row in rows], down=True, gap=GAP)


def tinted(video: Picture, masks: NDArray[np.uint8]) -> Picture:
    """Frames ``[T, H, W, 3]`` in pale grey, with each instance of the masks in its colour."""
    grey = video.mean(-1, keepdims=True) * 0.35 + 160
    tints = np.array([COLOURS[(k - 1) % len(COLOURS)] for k in range(256)], float)
    there = masks[..., None] > 0
    return np.where(there, 0.25 * grey + 0.75 * tints[masks], grey).round().astype(np.uint8)


def action_shares(actions: NDArray[np.floating], spec: ActionSpec) -> NDArray[np.floating]:
    """Actions ``[T, A]`` between their upper bounds, 0, and their lower bounds, 1.

    The last action, which leads to no frame, is the one before.
    """
    low, high = np.array(spec.low), np.array(spec.high)
    shares = np.clip((high - actions) / (high - low), 0, 1)
    shares[-1:] = shares[-2:-1] if len(shares) > 1 else shares[-1:]
    return shares


def draw_curves(shares: NDArray[np.floating], width: int, now: int | None = None) -> Picture:
    """The curves of `action_shares` over the episode, with a line at frame `now`."""
    image = Image.new("RGB", (width, CURVES), "white")
    pen = ImageDraw.Draw(image)
    pen.rectangle((0, 4, width - 1, CURVES - 1), outline=PALE)
    x = 1 + np.arange(len(shares)) / max(len(shares) - 1, 1) * (width - 3)
    if now is not None:
        pen.line([(x[now], 4), (x[now], CURVES - 1)], fill=INK)
    for index, curve in enumerate(shares.T):
        points = zip(x.tolist(), (7 + curve * (CURVES - 11)).tolist(), strict=True)
        pen.line([*points], fill=COLOURS[index % len(COLOURS)], width=2)
    return np.asarray(image)


def legend(title: str, names: Sequence[str], width: int) -> Picture:
    """A title, and names in the colours of what they stand for."""
    lines: list[TextLine] = [[(title, INK)]]
    for index, name in enumerate(names):
        piece = (f"  {name}", COLOURS[index % len(COLOURS)])
        if FONT.getlength("".join(text for text, _ in [*lines[-1], piece])) > width - 4:
            lines.append([])
        lines[-1].append(piece)
    return _strip(lines, width)


def magnified(frame: Picture) -> Picture:
    """Enlarge small frames by drawing each pixel several times."""
    return enlarge(frame, math.ceil(MIN_SIDE / min(frame.shape[-3:-1])))


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
