"""Recorded episodes from any source, and how they are imported as a data folder."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard, package_versions
from acwm_core.data.dataset import Manifest
from acwm_core.data.generate import fill
from acwm_core.data.readme import write_readme
from acwm_core.env.card import check_episode
from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.env.episode import SPLITS, Episode, EpisodeSpec, Split
from acwm_core.errors import AcwmError, DataError
from acwm_core.executors import LocalExecutor
from acwm_core.files import writing

UNSEEN = "Recorded: without instance masks (all zero) and contacts (none)."


@dataclass(frozen=True)
class Recording:
    """The recorded data of one episode.

    The arrays may differ in length; only the frames that all of them cover are kept.

    Attributes:
        video: ``[T, H, W, 3]`` uint8, with the frame size of the dataset.
        actions: ``[T, A]`` or ``[T − 1, A]``; row i leads from frame i to frame i + 1, so a T-th
            row leads to no frame and is dropped.
        states: arrays of numbers by name, each ``[T, …]``.
    """

    video: NDArray[np.uint8]
    actions: NDArray[np.floating[Any]]
    states: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])

    @property
    def frames(self) -> int:
        """Number of frames that all arrays cover."""
        return min([len(self.video), len(self.actions) + 1, *map(len, self.states.values())])


class Recordings(Protocol):
    """Recordings by index, from 0: a list, or an object that reads them on request.

    To be sent to workers, it must be picklable, importable and small.
    """

    def __len__(self) -> int:
        """Number of recordings."""
        ...

    def __getitem__(self, index: int, /) -> Recording:
        """Read one recording."""
        ...


@dataclass(frozen=True)
class RecordedDataset:
    """Recordings to import.

    Attributes:
        environment: the environment card of what they show; `recorded_card` makes one.
        splits: the recordings of each split.
        facts: `kind` and `name` of what is imported, and what identifies it, e.g. checksums. They
            are kept in the card and compared when an import is resumed. They may include, for
            people, the `command` that imports it, as `import_command` writes it.
        notes: sentences for people, kept in the card.
        seed: seed of the dataset, if the recordings were made with one.
        nominal: number of frames that each recording of a split should have; those that have
            fewer are counted in the notes.
    """

    environment: EnvironmentCard
    splits: Mapping[Split, Recordings]
    facts: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    seed: int = 0
    nominal: Mapping[Split, Sequence[int]] = field(default_factory=dict[Split, Sequence[int]])


def recorded_card(
    name: str,
    action: ActionSpec,
    *,
    frame_size: tuple[int, int],
    fps: int,
    horizon: int,
    state: Sequence[StateField] = (),
    summary: str = "",
    engine: str = "recorded",
    citation: str = "",
) -> EnvironmentCard:
    """The environment card of recorded data: no factors, one instance, no simulator."""
    return EnvironmentCard(
        name=name,
        summary=f"{summary.removesuffix(UNSEEN).rstrip('. ')}. {UNSEEN}".removeprefix(". "),
        action=action,
        frame_size=frame_size,
        fps=fps,
        horizon=horizon,
        factors=(),
        ood_shifts=(),
        state=tuple(state),
        instances=("unlabelled",),  # every pixel of the masks has id 0
        engine=engine,
        citation=citation,
    )


def import_dataset(
    recorded: RecordedDataset,
    out: str | Path,
    *,
    workers: int | None = None,
    shard_episodes: int = 32,
    progress: bool = True,
) -> DatasetCard:
    """Write recordings as the data folder `out`.

    Finished shards are kept, so the same call resumes where a killed one ended. Each worker holds
    one recording in memory at a time.

    Args:
        recorded: what a format read, e.g. ``LeRobot().read(root)``.
        workers: number of processes, one per core by default; 0 imports in this process.

    Returns:
        The card of the folder.

    Raises:
        DataError: a recording cannot be read or does not match the card; the folder holds another
            dataset or is in use.
    """
    out, environment = Path(out), recorded.environment
    counts: dict[Split, int] = {s: len(recorded.splits.get(s, ())) for s in SPLITS}
    wanted = DatasetCard(
        environment=environment,
        splits={split: count for split, count in counts.items() if count},
        seed=recorded.seed,
        options={"size": list(environment.frame_size)},
        factors={},
        shard_episodes=shard_episodes,
        versions=package_versions(),
        source=dict(recorded.facts),
    )
    if not wanted.splits:
        raise DataError(f"{recorded.facts['name']} holds no recordings")
    source = functools.partial(_recorded, environment, dict(recorded.splits))
    made = fill(out, wanted, source, LocalExecutor(workers), progress=progress)
    notes = [*recorded.notes]
    for split, nominal in recorded.nominal.items():
        lengths = [n for record in Manifest(out / split).ordered() for n in record.lengths]
        if short := sum(n < said for n, said in zip(lengths, nominal, strict=True)):
            counted = f"{short} of {len(lengths)} are shorter than they are said to be"
            notes.append(f"{split}: {counted}")
    made = replace(made, source={**made.source, "notes": notes})
    with writing(out):
        made.write(out)
        write_readme(out, made)
    return made


def recorded_episode(recording: Recording, spec: EpisodeSpec, card: EnvironmentCard) -> Episode:
    """Convert a recording to an `Episode`.

    Raises:
        DataError: it has fewer than two frames, or does not match the card.
    """
    frames = recording.frames
    if frames < 2:
        raise DataError(f"it has {frames} usable frames, and an action leads from one to another")
    video = np.asarray(recording.video[:frames])
    if video.dtype != np.uint8 or video.ndim != 4 or video.shape[3] != 3:
        raise DataError(f"video is {video.dtype} {video.shape}, not uint8 [T, H, W, 3]")
    actions = np.zeros((frames, card.action.size), np.float32)
    given = np.asarray(recording.actions)
    if given.ndim != 2 or given.shape[1] != card.action.size:
        raise DataError(f"actions are {given.shape}, not [T, {card.action.size}]")
    actions[:-1] = given[: frames - 1]
    episode = Episode(
        spec=spec,
        video=video,
        actions=actions,
        states={name: np.asarray(rows[:frames]) for name, rows in recording.states.items()},
        masks=np.zeros((frames, *card.frame_size), np.uint8),
        contacts=np.zeros((0, 3), np.int32),
        factors={},
        ood_label=None,
    )
    check_episode(episode, card)
    return episode


def _recorded(
    card: EnvironmentCard, splits: Mapping[Split, Recordings], specs: Sequence[EpisodeSpec]
) -> Iterator[Episode]:
    for spec in specs:
        try:
            episode = recorded_episode(splits[spec.split][spec.index], spec, card)
        except (AcwmError, OSError) as error:
            raise DataError(f"episode {spec.index} of {spec.split}: {error}") from error
        yield episode
