"""The options that every import has on the command line, whatever the format."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.arguments import size

if TYPE_CHECKING:
    from acwm_formats.reading import Bounds, ImportOptions

KINDS = ("absolute", "velocity", "torque", "delta")


def _rate(_: click.Context, __: click.Parameter, value: str | None) -> Fraction | None:
    try:
        rate = None if value is None else Fraction(value)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if rate is not None and rate <= 0:
        raise click.BadParameter(f"{value!r} is not a rate: give 10, 29.97 or 30000/1001")
    return rate


def _distances(
    _: click.Context, __: click.Parameter, value: str | None
) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        near, far = (float(part) for part in value.split(","))
    except ValueError:
        why = f"{value!r}: give two distances in metres, such as 0.3,2"
        raise click.BadParameter(why) from None
    return near, far


def _bounds(_: click.Context, __: click.Parameter, value: str) -> Bounds:
    if value == "range" or value == "quantile":
        return value
    try:
        ends = [float(part) for part in value.split(",")]
    except ValueError:
        ends = list[float]()
    if ends and len(ends) % 2 == 0:
        return tuple(ends[::2]), tuple(ends[1::2])
    if not ends and Path(value).is_dir():
        from acwm_core.data.card import DatasetCard

        action = DatasetCard.read(value).environment.action
        return action.low, action.high
    raise click.BadParameter(
        f"{value!r}: give range, quantile, LOW,HIGH such as -1,1, or the folder of a dataset or run"
    )


def _kinds(_: click.Context, __: click.Parameter, value: str | None) -> tuple[str, ...]:
    kinds = tuple(value.split(",")) if value else ()
    for kind in kinds:
        if kind not in KINDS:
            raise click.BadParameter(f"{kind!r} is none of {', '.join(KINDS)}")
    return kinds


def _option(words: list[str], text: str, **settings: Any) -> click.Option:
    has_default = settings.get("default") is not None
    return click.Option(words, help=text, show_default=has_default, **settings)


OPTIONS = (
    _option(
        ["--camera", "cameras"],
        "Camera to show; given several times, they are put side by side. By default the first one "
        "that has colours.",
        multiple=True,
    ),
    _option(
        ["--size"],
        "Frame size of a camera, 64 or HEIGHTxWIDTH; by default that of the recordings.",
        type=size,
    ),
    _option(["--fps"], "Frames per second to resample to.", metavar="RATE", callback=_rate),
    _option(
        ["--tolerance"],
        "Largest error of times, in frame intervals.",
        type=click.FloatRange(0, 1, max_open=True),
        default=0.25,
    ),
    _option(
        ["--max-gap"],
        "Longest gap of frames or actions that is filled with the previous value.",
        type=click.IntRange(0),
        default=2,
    ),
    _option(
        ["--on-defect"],
        "What to do with defective recordings; trim keeps their usable parts.",
        type=click.Choice(["refuse", "skip", "trim"]),
        default="refuse",
    ),
    _option(
        ["--shift"],
        "Move actions this many frames later; negative: earlier.",
        type=int,
        default=0,
    ),
    _option(
        ["--action-kind", "kinds"],
        "What actions command, or each of their dimensions: absolute (held between frames), "
        "velocity or torque (averaged), delta (summed).",
        metavar="KIND,…",
        callback=_kinds,
    ),
    _option(
        ["--bounds"],
        "Bounds of actions: the range of the training episodes, the same without outliers "
        "(quantile), LOW,HIGH of all dimensions or of each in turn, or those of a dataset "
        "or a run, given by its folder. Actions are clipped to them.",
        metavar="range|quantile|LOW,HIGH,…|FOLDER",
        callback=_bounds,
        default="range",
    ),
    _option(
        ["--depth-range"],
        "Distances in metres that become white and black in depth maps.",
        metavar="NEAR,FAR",
        callback=_distances,
    ),
    _option(["--environment"], "Name of the environment."),
    _option(
        ["--test-episodes"],
        "Number of last recordings that become ind_test; by default those that the "
        "source names, else a tenth, at least five (two of fewer than ten recordings).",
        type=click.IntRange(0),
    ),
)

NAMES = {str(option.name) for option in OPTIONS} | {"camera", "action_kind"}
"""Names that no format may use for options of its own."""


def import_options(
    *,
    cameras: tuple[str, ...],
    size: Any,
    bounds: Any,
    depth_range: tuple[float, float] | None,
    environment: str | None,
    test_episodes: int | None,
    **alignment: Any,
) -> ImportOptions:
    """The values of `OPTIONS` as what an import takes."""
    from acwm_formats.alignment import Alignment
    from acwm_formats.reading import ImportOptions

    how = Alignment(**alignment)
    return ImportOptions(size, cameras, depth_range, environment, test_episodes, bounds, how)
