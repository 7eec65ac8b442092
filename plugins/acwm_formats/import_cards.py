"""What is written about imported recordings: the dataset's card, notes, and the command."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard, package_versions
from acwm_core.env.card import ActionSpec, plain_rate
from acwm_core.env.environment import EnvironmentCard, StateField
from acwm_core.env.episode import SPLITS, Split
from acwm_core.env.state_field import without_dangling
from acwm_core.errors import DataError
from acwm_formats.alignment import Alignment
from acwm_formats.bounds import action_bounds, beyond, outliers
from acwm_formats.reading import Bounds, CommonReading, ImportOptions, Scan
from acwm_formats.survey.action_rate import ActionRate
from acwm_formats.timeline import RecordedDataset

UNSEEN = "Recorded: without instance masks (all zero) and contacts (none)."
MOST_TOLD = 50  # notes and defects that are listed one by one


def recorded_card(
    name: str,
    action: ActionSpec,
    *,
    frame_size: tuple[int, int],
    fps: float | Fraction,
    horizon: int,
    state: Sequence[StateField] = (),
    summary: str = "",
    engine: str = "recorded",
    citation: str = "",
    views: tuple[str, ...] = (),
    instances: tuple[str, ...] = (),
) -> EnvironmentCard:
    """The environment card of recorded data: no factors, no simulator, often no instances."""
    unseen = "" if instances else UNSEEN
    return EnvironmentCard(
        name=name,
        summary=f"{summary.removesuffix(UNSEEN).rstrip('. ')}. {unseen}".removeprefix(". ").strip(),
        action=action,
        frame_size=frame_size,
        fps=plain_rate(fps),
        horizon=horizon,
        factors=(),
        ood_shifts=(),
        state=without_dangling(state, instances),
        instances=instances or ("unlabelled",),  # every pixel of such masks has id 0
        engine=engine,
        citation=citation,
        views=views,
    )


@dataclass(frozen=True)
class Described:
    """What is known of an import before its recordings are decoded.

    Attributes:
        cameras: all that the recordings have.
    """

    recorded: RecordedDataset
    options: ImportOptions
    reading: CommonReading
    cameras: tuple[str, ...]

    def command(self) -> dict[str, str]:
        """The command that imports the same again, if there is one."""
        if self.recorded.options is None:
            return {}
        kind, name = (str(self.recorded.facts[key]) for key in ("kind", "name"))
        options = {**self.recorded.options, **self._words()}
        return {"command": import_command(kind, name, **options)}

    def card(
        self,
        fps: float,
        plan: str,
        shard_episodes: int,
        kept: Sequence[Scan],
        skipped: Sequence[str] = (),
        rate: ActionRate | None = None,
    ) -> DatasetCard:
        """The card of the dataset that holds the recordings `kept`, whose actions have a rate."""
        present = [split for split in SPLITS if any(scan.split == split for scan in kept)]
        rows = {split: _rows([k for k in kept if k.split == split]) for split in present}
        basis = rows.get("train", np.zeros((0, 0), np.float32))
        action = self._action(basis if len(basis) else np.concatenate([*rows.values()]))
        counts: dict[Split, int] = {
            s: sum(len(k.lengths) for k in kept if k.split == s) for s in SPLITS
        }
        size = self.reading.size
        environment = recorded_card(
            self.options.environment or self.recorded.name,
            action,
            frame_size=(size[0], size[1] * len(self.reading.cameras)),
            fps=fps,
            horizon=max(length for scan in kept for length in scan.lengths),
            state=self.reading.state,
            summary=self.recorded.summary,
            engine=self.recorded.engine,
            citation=self.recorded.citation,
            views=self.reading.cameras if len(self.reading.cameras) > 1 else (),
            instances=self.reading.instances,
        )
        notes = self._notes(kept, rows, action)
        if rate:
            notes.insert(0, f"{rate.sentence[0].upper()}{rate.sentence[1:]}.")
        about = {"plan": plan, "notes": notes, **(rate.to_source() if rate else {})}
        source = {**self.recorded.facts, **about, **self.command()}
        if skipped:
            source["skipped"] = list(few(skipped))
        return DatasetCard(
            environment=environment,
            splits={split: count for split, count in counts.items() if count},
            seed=self.recorded.seed,
            options={"size": list(environment.frame_size)},
            factors={},
            shard_episodes=shard_episodes,
            versions=package_versions(),
            source=source,
        )

    def _action(self, rows: NDArray[np.float32]) -> ActionSpec:
        """What the actions are, with bounds of `rows` if none are stated."""
        action, kinds = self.reading.action, self.options.alignment.kinds
        action = replace(action, kind=max(kinds, key=kinds.count) if kinds else action.kind)
        if self.reading.stated:
            return action
        if isinstance(given := self.options.bounds, tuple):
            if len(given[0]) not in (1, action.size):
                wrong = f"{len(given[0])} dimensions, and the actions {action.size}"
                raise DataError(f"--bounds has those of {wrong}: {', '.join(action.names)}")
            low, high = (bound * action.size if len(bound) == 1 else bound for bound in given)
            return replace(action, low=low, high=high)
        low, high = action_bounds(rows, quantile=self.options.bounds == "quantile")
        if self.recorded.actions.bounds is not None:
            low, high = np.minimum(low, action.low), np.maximum(high, action.high)
        return replace(action, low=tuple(low.tolist()), high=tuple(high.tolist()))

    def _notes(
        self, kept: Sequence[Scan], rows: Mapping[str, NDArray[np.float32]], action: ActionSpec
    ) -> list[str]:
        """What people should know about the dataset."""
        notes, alignment = [*self.recorded.notes], self.options.alignment
        if isinstance(self.options.bounds, tuple):
            notes.append("The bounds of actions are those of --bounds.")
        elif self.recorded.actions.bounds is None:
            quantile = self.options.bounds == "quantile"
            which = "the range without a hundredth at either end" if quantile else "the range"
            notes.append(f"The bounds of actions are {which} of the training episodes.")
            if not quantile and "train" in rows:
                notes += outliers(rows["train"], action.names)
        for split, some in rows.items():
            notes += [f"{split}: {note}" for note in (beyond(some, action) if len(some) else ())]
        if self.recorded.instances and not self.reading.instances:
            notes.append(
                "Masks and contacts were omitted, because they belong to frames of another size."
            )
        if alignment.shift:
            unit = "frame" if abs(alignment.shift) == 1 else "frames"
            notes.append(f"Actions were moved by {alignment.shift} {unit}.")
        of_recordings = _notes_by_recording(
            [(scan.name, note) for scan in kept for note in scan.notes]
        )
        of_recordings += [
            f"{defect}: its usable parts were kept" for scan in kept for defect in scan.defects
        ]
        others = [name for name in self.cameras if name not in self.reading.cameras]
        if others:
            notes.append(f"Frames of {self.reading.cameras[0]}; other cameras: {', '.join(others)}")
        return [*notes, *few(of_recordings)]

    def _words(self) -> dict[str, object]:
        """The options of the command that imports the same again."""
        asked, alignment, usual = self.options, self.options.alignment, Alignment()
        several = len(self.cameras) > 1
        height, width = self.reading.size
        words: dict[str, object] = {
            "camera": list(self.reading.cameras) if several else None,
            "size": f"{height}x{width}",
            "environment": asked.environment,
            "test_episodes": asked.test_episodes,
            "bounds": None if asked.bounds == "range" else bounds_as_typed(asked.bounds),
            "depth_range": asked.depth_range
            and ",".join(f"{limit:g}" for limit in asked.depth_range),
        }
        kinds = ",".join(alignment.kinds)
        known = ",".join(self.recorded.actions.kinds(self.reading.action.size))
        words["action_kind"] = None if kinds == known else kinds
        names = ("fps", "tolerance", "max_gap", "shift", "on_defect")
        changed = {name: getattr(alignment, name) for name in names}
        return words | {n: v for n, v in changed.items() if v != getattr(usual, n)}


def bounds_as_typed(bounds: Bounds) -> str:
    """The value of ``--bounds``: a word, or LOW,HIGH of each dimension."""
    if not isinstance(bounds, tuple):
        return bounds
    pairs = zip(*bounds, strict=True)
    return ",".join(f"{limit!r}" for pair in pairs for limit in pair)


def _rows(kept: Sequence[Scan]) -> NDArray[np.float32]:
    """Rows of the actions of some recordings ``[N, A]``."""
    rows = [scan.actions for scan in kept if len(scan.actions)]
    return np.concatenate(rows) if rows else np.zeros((0, 0), np.float32)


def _notes_by_recording(notes: Sequence[tuple[str, str]]) -> list[str]:
    """Notes with the names of their recordings; a note that many share is given once."""
    names: dict[str, list[str]] = {}
    for name, note in notes:
        names.setdefault(note, []).append(name)
    return [
        f"{some[0]}: {note}"
        if len(some) == 1
        else f"{len(some)} recordings, e.g. {some[0]}: {note}"
        for note, some in names.items()
    ]


def few(lines: Sequence[str]) -> Sequence[str]:
    """The lines, or the first of them and how many more there are."""
    if len(lines) <= MOST_TOLD:
        return lines
    return [*lines[:MOST_TOLD], f"and {len(lines) - MOST_TOLD} more"]


def import_command(kind: str, name: str, **options: object) -> str:
    """The command ``acwm data import KIND NAME --option value …``.

    Options of None or False are left out, and one of True has no value.
    """
    words = ["acwm", "data", "import", kind, name]
    for option, value in options.items():
        for entry in value if isinstance(value, list) else [value]:  # pyright: ignore
            if entry is None or entry is False:
                continue
            size = "x".join(map(str, cast(Any, entry))) if isinstance(entry, tuple) else str(entry)
            words += [f"--{option.replace('_', '-')}", *([] if entry is True else [size])]
    return shlex.join(words)
