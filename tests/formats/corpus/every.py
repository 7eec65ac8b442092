"""Every recording of the corpus, and what is right."""

import math
from fractions import Fraction

import numpy as np

from tests.formats.corpus import spoiling
from tests.formats.corpus.cases import (
    COUNT,
    NTSC,
    Case,
    acting,
    arrays,
    episode,
    moments,
    pictures,
    rated,
    stored_as,
    three,
)
from tests.formats.corpus.clips import Clip

B_FRAMES = {"bf": "3", "preset": "fast", "x264-params": "b-adapt=0:log-level=none"}
VIDEOS, ARRAYS = ("videos",), ("hdf5", "zarr")
NEAR_FAR = {"depth-range": "0.5,1.5"}
ASKED = "--depth-range"

RATES = [rated(rate) for rate in (10, 15, 25, NTSC, 30, Fraction(60000, 1001))]

CODECS = [
    stored_as("H.264"),
    stored_as("H.264 of full range", pixels="yuvj420p"),
    stored_as("H.264 4:4:4", pixels="yuv444p"),
    stored_as("H.264 of 10 bits", pixels="yuv420p10le"),
    stored_as("H.264 in RGB", "libx264rgb", "rgb24"),
    stored_as("H.264 with B-frames", clip=Clip(options=B_FRAMES)),
    stored_as("HEVC", "libx265"),
    stored_as("HEVC of 10 bits", "libx265", "yuv420p10le"),
    stored_as("HEVC of 12 bits", "libx265", "yuv420p12le"),
    stored_as("AV1", "libsvtav1"),
    stored_as("AV1 of 10 bits", "libsvtav1", "yuv420p10le"),
    stored_as("VP9", "libvpx-vp9", "yuv420p", "webm"),
    stored_as("VP9 with alpha", "libvpx-vp9", "yuva420p", "webm"),
    stored_as("MPEG-4", "mpeg4"),
    stored_as("MJPEG", "mjpeg", "yuvj420p", "avi"),
    stored_as("ProRes", "prores_ks", "yuv422p10le", "mov"),
    stored_as("Animation with alpha", "qtrle", "argb", "mov"),
    stored_as("PNG of 48 bits", "png", "rgb48be", "mov"),
    stored_as("grey", "ffv1", "gray", "mkv", grey=True),
    stored_as("grey of 16 bits", "ffv1", "gray16le", "mkv", refused=ASKED),
    stored_as("depth of 16 bits", "ffv1", "gray16le", "mkv", options=NEAR_FAR, depth=True),
    stored_as("depth of 12 bits", "libx265", "gray12le", refused=ASKED),
]

CONTAINERS = [
    stored_as("mkv", suffix="mkv"),
    stored_as("webm", "libsvtav1", suffix="webm"),
    stored_as("mov", suffix="mov"),
    stored_as("avi", "mpeg4", suffix="avi"),
    stored_as("gif", clip=Clip(suffix="gif")),
    *(pictures(f"folder of {each}", each) for each in ("png", "jpg", "webp", "bmp", "tif")),
    pictures("pictures with alpha", "png", "alpha"),
    pictures("pictures in grey", "png", "grey", grey=True),
    pictures("pictures of 16 bits", "png", "depth", refused=ASKED),
    pictures("pictures of depth", "png", "depth", depth=True, options=NEAR_FAR),
    pictures("pictures with times", "png", column="time"),
]

SHAPES = [
    Case("odd size", three(), size=(49, 67), clip=Clip(pixels="yuv444p")),
    Case("tall", three(), size=(96, 32)),
    Case("wide", three(), size=(32, 160)),
    stored_as("turned left", clip=Clip(rotation=90)),
    stored_as("upside down", clip=Clip(rotation=180)),
    stored_as("turned right", clip=Clip(rotation=270)),
    stored_as("wide pixels", clip=Clip(aspect=Fraction(2))),
    Case(
        "one of another size",
        three(),
        clip=Clip(),
        spoil=spoiling.other_size,
        only=VIDEOS,
        refused="--size",
    ),
]


def cut_by_3(name, clip):
    """Recordings whose first three frames an edit list hides; they have no rows, either."""
    lengths = range(COUNT, COUNT + 3)
    times = [tuple(Fraction(k, 10) for k in range(3, n)) for n in lengths]
    episodes = [episode(40 * i, n, row_times=times[i]) for i, n in enumerate(lengths)]
    answer = tuple(each.numbers[3:] for each in episodes)
    return Case(name, tuple(episodes), clip=clip, answer=answer, only=VIDEOS)


LATE, LOST, GAP = (*range(2, 10),), (0, 1, 2, 4, 5, 6, 7, 8), (*range(6), *range(20, 26))
FINE = Clip(tick=Fraction(1, 1000), suffix="mkv")  # in milliseconds
TWICE = Clip("mjpeg", "yuvj420p", "mkv", tick=Fraction(1, 1000))
TIMED = {"clip": FINE, "column": "time", "only": ("videos", "mcap")}
FILLED = {"first": (0, 1, 2, 2, 4, 5, 6, 7, 8), "taken": range(8), "told": "filled"}
CUT = ((*range(6),), (*range(20, 26),), *(each.numbers for each in three()[1:]))

TIMES = [
    moments("late start", LATE, **TIMED),
    moments("late start without times", LATE, range(2, 10), clip=Clip(), only=VIDEOS),
    moments("a lost frame", LOST, **TIMED, **FILLED),
    moments("a lost frame by number", LOST, **{**TIMED, "column": "frame"}, **FILLED),
    moments("a gap", GAP, **TIMED, refused="missing"),
    moments("a gap to cut", GAP, **TIMED, options={"on-defect": "trim"}, answer=CUT),
    moments("a variable rate", (0, 1, 1.4, 3, 3.5, 5, 7.5, 9), **TIMED, refused="--fps"),
    moments(
        "a variable rate at 10",
        (0, 1, 2, 2.5, 3, 4, 5, 6),
        **TIMED,
        options={"fps": 10},
        first=(0, 1, 2, 4, 5, 6, 7),
        taken=range(6),
    ),
    moments(
        "two frames at one moment",
        (0, 1, 2, 3, 3, 4, 5, 6),
        **{**TIMED, "clip": TWICE},
        refused="the time of the frame before",
    ),
    moments(
        "rows that go back",
        (*range(8),),
        (0, 1, 2, 1, 2, 3, 4, 5),
        **{**TIMED, "only": VIDEOS},
        refused="back",
    ),
    moments(
        "rows at one moment",
        (*range(8),),
        (0, 1, 2, 2, 3, 4, 5, 6),
        **{**TIMED, "only": VIDEOS},
        refused="the time of the frame before",
    ),
    moments(
        "lost rows",
        (*range(12),),
        (0, 1, 2, 3, 6, 7, 8, 9, 10, 11),
        column="frame",
        only=VIDEOS,
        told="filled",
    ),
    moments(
        "rows of another rate", (*range(8),), [k / 2 for k in range(16)], column="time", only=VIDEOS
    ),
    moments(
        "more rows than frames",
        (*range(8),),
        (*range(12),),
        only=(*VIDEOS, "lerobot"),
        refused="12 rows",
    ),
    moments(
        "fewer rows than frames",
        (*range(8),),
        (*range(5),),
        only=(*VIDEOS, "lerobot"),
        refused="5 rows",
    ),
    moments(
        "a row less than frames",
        (*range(8),),
        (*range(7),),
        only=("videos", "hdf5", "mcap"),
    ),
    Case(
        "half the rate",
        three(),
        options={"fps": 5},
        answer=tuple(each.numbers[::2] for each in three()),
        only=(*VIDEOS, "mcap"),
    ),
    cut_by_3("an edit list", Clip(shift=-3)),
    cut_by_3("an edit list and B-frames", Clip(shift=-3, options=B_FRAMES)),
    Case("times in milliseconds", three(), column="time_ms", only=VIDEOS),
    Case(
        "times of another clock",
        three(),
        column="stamp_ns",
        only=VIDEOS,
        refused="--from-first-row",
    ),
    Case(
        "times since 1970",
        three(),
        column="stamp_ns",
        only=VIDEOS,
        options={"from-first-row": True},
    ),
]


def ramp(dtype):
    """Rows that grow."""
    return lambda count: np.stack([np.arange(count), np.arange(count) % 3], 1).astype(dtype)


def broken(value):
    """Rows with a value that is no number, as lists."""

    def rows(count):
        found = ramp(float)(count).tolist()
        found[3][1] = value
        return found

    return rows


def ragged(count):
    """Rows of which one has a value less."""
    found = ramp(float)(count).tolist()
    found[3] = found[3][:1]
    return found


ACTIONS = [
    acting("of whole numbers", ramp(np.int64)),
    acting("of bytes", ramp(np.uint8), only=("hdf5", "zarr", "videos")),
    acting("of float16", ramp(np.float16), only=("hdf5", "zarr", "videos")),
    acting("of float64", ramp(np.float64)),
    acting(
        "of bool",
        lambda count: ramp(int)(count) % 2 == 1,
        table="parquet",
        only=("hdf5", "zarr", "videos"),
    ),
    acting(
        "with NaN",
        lambda count: np.array(broken(math.nan)(count)),
        refused="finite",
        only=("hdf5", "zarr", "videos", "lerobot"),
    ),
    acting("with an empty field", broken(""), refused="row 3", only=VIDEOS),
    acting("with a word", broken("left"), refused="left", only=VIDEOS),
    acting("that are ragged", ragged, refused="take_8.csv", only=VIDEOS),
    acting("that are ragged in JSON", ragged, table="jsonl", refused="row 3", only=VIDEOS),
    acting("of one column", lambda count: ramp(float)(count)[:, :1], only=VIDEOS),
    *(
        Case(f"a table in {table}", three(), table=table, only=VIDEOS)
        for table in ("semicolons", "npy", "npz", "json", "jsonl", "parquet", "vectors", "shared")
    ),
]

FILES = [
    Case("names", three(), names=("Grüße 1", "Grüße 2", "Ärm & Öl 10"), only=VIDEOS),
    Case("natural order", three(), names=("take 2", "take 10", "take 100"), only=VIDEOS),
    *(
        Case(
            f"one of three that is {how.__name__}",
            three(),
            spoil=how,
            refused="take_9",
            only=VIDEOS,
        )
        for how in (spoiling.empty, spoiling.cut_off, spoiling.a_playlist, spoiling.flipped_bytes)
    ),
    Case(
        "one to skip",
        three(),
        spoil=spoiling.empty,
        options={"on-defect": "skip"},
        answer=(three()[0].numbers, three()[2].numbers),
        told="take_9",
        only=VIDEOS,
    ),
    Case("one without a table", three(), spoil=spoiling.no_table, refused="take_9", only=VIDEOS),
]

PIXELS = [
    arrays("grey", grey=True),
    arrays("alpha"),
    arrays("first"),
    arrays("float"),
    arrays("float255"),
    arrays("half"),
    arrays("16 bits", refused="--pixel-range"),
    arrays("12 bits", options={"pixel-range": "0,4080"}),
    arrays("signed", options={"pixel-range": "-1,1"}),
    arrays("depth", refused=ASKED),
    Case("depth in millimetres", three(), clip=None, pixels="depth", depth=True, options=NEAR_FAR),
    Case("depth in metres", three(), clip=None, pixels="metres", depth=True, options=NEAR_FAR),
]

CASES = [*RATES, *CODECS, *CONTAINERS, *SHAPES, *TIMES, *ACTIONS, *FILES, *PIXELS]
