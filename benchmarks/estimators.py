"""Noise floors of the estimators: their errors on true videos of test episodes.

    python benchmarks/estimators.py data/push_cube data/reacher_small

Each row is a split of a dataset. It makes the table of docs/findings/estimators.md.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Episode, Split
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.errors import AcwmError
from acwm_core.evaluation.score import estimator_for
from acwm_estimators.layout import Layout, layout_of
from acwm_estimators.targets import MIN_SEEN, points_there, rows_of
from acwm_estimators.turns import heading

Errors = dict[str, list[np.ndarray]]
"""Errors by quantity and unit, e.g. ``"cube_position px"``."""


class Overlap:
    """Intersections and unions of masks by instance, over many frames."""

    def __init__(self, count: int) -> None:
        self.both, self.either, self.true = np.zeros((3, count))

    def add(self, true: np.ndarray, found: np.ndarray) -> None:
        """Count pixels of masks `[T, H, W]`."""
        for instance in range(1, len(self.both)):
            a, b = true == instance, found == instance
            self.both[instance] += (a & b).sum()
            self.either[instance] += (a | b).sum()
            self.true[instance] += a.sum()

    def by_name(self, names: tuple[str, ...], read: tuple[str, ...]) -> dict[str, float]:
        """The IoU of every instance that the estimator reads and that was present."""
        ids = {name: names.index(name) for name in read}
        return {n: self.both[i] / self.either[i] for n, i in ids.items() if self.true[i]}


def point_errors(
    estimator: StateEstimator, layout: Layout, episode: Episode, seen: Observation, errors: Errors
) -> None:
    """Add errors of positions in pixels and millimetres, for rows that are present and visible."""
    for points in layout.points:
        true = rows_of(episode.states[points.field], points)
        found = rows_of(seen.states[points.field], points)
        there = points_there(episode.masks, points, estimator.card, MIN_SEEN) > 0
        missed = there & np.isnan(found[..., 0])
        errors.setdefault(f"{points.field} not found %", []).append(100 * missed[there])
        pixels = [estimator.pixels(points.field, values) for values in (found, true)]
        for unit, (a, b) in {"px": pixels, "mm": (1000 * found, 1000 * true)}.items():
            distance = np.linalg.norm(a - b, axis=-1)[there & ~missed]
            errors.setdefault(f"{points.field} {unit}", []).append(distance)


def curve_errors(
    estimator: StateEstimator, layout: Layout, episode: Episode, seen: Observation, errors: Errors
) -> None:
    """Add errors of curves: the mean distance of their nodes, for the better order of the ends."""
    for curve in layout.curves:
        true, found = (np.asarray(s[curve.field], float) for s in (episode.states, seen.states))
        traced = np.isfinite(found).all((1, 2))
        errors.setdefault(f"{curve.field} not traced %", []).append(100.0 * ~traced)
        pixels = [estimator.pixels(curve.field, values) for values in (found, true)]
        for unit, (a, b) in {"px": pixels, "mm": (1000 * found, 1000 * true)}.items():
            ways = [np.linalg.norm(way - b, axis=-1).mean(1) for way in (a, a[:, ::-1])]
            errors.setdefault(f"{curve.field} {unit}", []).append(np.min(ways, axis=0)[traced])


def number_errors(layout: Layout, episode: Episode, seen: Observation, errors: Errors) -> None:
    """Add errors of angles in degrees, up to symmetries, and of amounts in percent."""
    for local in layout.locals:
        true, found = (np.asarray(s[local.field], float) for s in (episode.states, seen.states))
        if local.column is not None:
            true, found = true[:, local.column], found[:, local.column]
        if local.encoding == "yaw":
            true, found = heading(true), heading(found)
        if local.encoding == "axes":
            off, unit = box_angle(true, found), "°"
        elif local.encoding == "value":
            off, unit = 1000 * np.abs(found - true.reshape(found.shape)), "mm"
        else:
            turn = 2 * np.pi / local.fold
            off, unit = np.degrees(np.abs((found - true + turn / 2) % turn - turn / 2)), "°"
        off = off.reshape(len(off), -1)[:, : local.count]
        (points,) = [points for points in layout.points if points.field == local.under]
        present = episode.states.get(points.field.removesuffix("_position") + "_present")
        there = np.isfinite(off) if present is None else np.isfinite(off) & (present > 0)
        errors.setdefault(f"{local.field} {unit}", []).append(off[there])
    for field in ("rope_length", "grain_count", "water_count"):
        if field in seen.states:
            true, found = (np.asarray(s[field], float) for s in (episode.states, seen.states))
            off = 100 * np.abs(found / true - 1).ravel()
            errors.setdefault(f"{field} %", []).append(off[np.isfinite(off)])
    for field, scale, unit in (("water_share", 100, "points"), ("sand_height", 1000, "mm")):
        if field in seen.states:
            off = np.abs(seen.states[field] - np.asarray(episode.states[field], float))
            errors.setdefault(f"{field} {unit}", []).append(scale * off.ravel())


def box_angle(true: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Angle in degrees between quaternions `[T, 4]`, the smallest over the half turns of a box."""
    w, x, y, z = np.moveaxis(found, -1, 0)
    alike = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    cosines = [np.abs((np.stack(each, -1) * true).sum(-1)) for each in alike]
    return np.degrees(2 * np.arccos(np.clip(np.max(cosines, axis=0), 0, 1)))


def every_nth(episode: Episode, step: int) -> Episode:
    """Keep every `step`-th frame of an episode."""
    some = slice(None, None, step)
    return replace(
        episode,
        video=episode.video[some],
        masks=episode.masks[some],
        states={name: values[some] for name, values in episode.states.items()},
        actions=np.zeros_like(episode.actions[some]),  # they no longer fit and are not read
    )


def measure(
    folder: Path, split: Split, most: int, step: int
) -> Iterator[tuple[str, str, str, str]]:
    """Rows of the table: quantity, mean, median and 95th percentile."""
    data = EpisodeDataset(folder, split)
    card = data.card.environment
    estimator = estimator_for(card)
    if estimator is None:
        raise AcwmError(f"there is no estimator for {card.name}")
    overlap, errors = Overlap(len(card.instances)), Errors()
    for index in range(min(most, len(data))):
        episode = every_nth(data[index], step)
        video = (
            torch.from_numpy(np.ascontiguousarray(episode.video)).permute(0, 3, 1, 2).float() / 255
        )
        seen = estimator.estimate(video)
        overlap.add(episode.masks, seen.masks)
        point_errors(estimator, layout_of(card.name), episode, seen, errors)
        curve_errors(estimator, layout_of(card.name), episode, seen, errors)
        number_errors(layout_of(card.name), episode, seen, errors)
    ious = overlap.by_name(card.instances, estimator.instances)
    yield "IoU, mean", f"{np.mean([*ious.values()]):.4f}", "", ""
    for name, value in ious.items():
        yield f"IoU {name}", f"{value:.4f}", "", ""
    for name, values in errors.items():
        all_values = np.concatenate(values)
        if len(all_values):
            middle, high = np.percentile(all_values, [50, 95])
            yield name, f"{all_values.mean():.3g}", f"{middle:.3g}", f"{high:.3g}"


@click.command()
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--episodes", default=24, show_default=True, help="At most, per split.")
@click.option("--every", default=1, show_default=True, help="Of so many frames, one is read.")
def main(folders: tuple[Path, ...], episodes: int, every: int) -> None:
    """Print the errors of estimators on the test splits of the datasets FOLDERS…"""
    console = Console(width=100)
    for folder in folders:
        try:
            card = DatasetCard.read(folder)
            height, width = card.environment.frame_size
            for split in [split for split in card.splits if split != "train"]:
                title = f"{card.environment.name} {height}×{width} {split}"
                table = Table("what", "mean", "median", "95 %", title=title, title_justify="left")
                for row in measure(folder, split, episodes, every):
                    table.add_row(*row)
                console.print(table)
        except AcwmError as error:
            sys.exit(str(error))


if __name__ == "__main__":
    main()
