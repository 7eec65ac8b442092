"""Generate a dataset: many episodes, by many workers, resumable, with the same bytes every time.

`fill` makes the shards of any dataset, simulated or recorded. A folder has one writer at a time. A
shard is a pure function of its `ShardTask`: it does not matter which worker makes it, when, or what
else runs.
"""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from acwm_core.data.card import CARD, DatasetCard, other_dataset, package_versions
from acwm_core.data.dataset import Manifest, action_statistics
from acwm_core.data.readme import write_readme
from acwm_core.data.shards import Packed, ShardRecord, open_shard, shard_name, write_shard
from acwm_core.data.simulate import make_environment, simulated
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import SPLITS, Episode, EpisodeSpec, FactorSetting, Split, draw_factors
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.executors import Executor, LocalExecutor, Report, progress_bar
from acwm_core.files import LOCK, held, remove_partial, writing
from acwm_core.plugins import catalog

EpisodeSource = Callable[[Sequence[EpisodeSpec]], Iterable[Episode | Packed]]
"""Yields the episodes of given specs, one after another; importable and picklable."""

SHARD_EPISODES = 32
"""Episodes per shard: a few MB at 64×64, a few tens at 240×240."""


def generate(
    environment: str,
    out: str | Path,
    *,
    episodes: Mapping[Split, int],
    seed: int = 0,
    size: int | tuple[int, int] | None = None,
    factors: Mapping[str, FactorSetting] | None = None,
    exploration: float = 0.0,
    shift: float = 0.0,
    workers: int | None = None,
    executor: Executor | None = None,
    shard_episodes: int = SHARD_EPISODES,
    progress: bool = True,
) -> DatasetCard:
    """Simulate episodes of an environment into the data folder `out`.

    The bytes depend only on the versions in the card and on the arguments other than `workers`,
    `executor` and `progress`. Finished shards are kept, so the same call resumes where a killed one
    ended. A call for another split adds it to the folder.

    Args:
        environment: registered name.
        out: the folder; created with its parents.
        episodes: how many per split; `parse_episodes` reads them from the command line.
        seed: seed of the dataset.
        size: frame size, one side or ``(H, W)``; the environment's by default.
        factors: factor settings that override those of the splits, e.g. ``{"friction": "ood"}``.
        exploration: share of the training episodes, from 0 to 1, that reuse the actions of the
            previous episode, chosen for another start. They show what actions do that do not fit
            the scene, which a behaviour policy never shows.
        shift: in these episodes one dimension of the actions, drawn for each, is shifted in all
            frames by up to this share of half its range, from 0 to 1.
        workers: number of processes, one per core by default; 0 simulates in this process.
        executor: runs the shards elsewhere, e.g. a `RayExecutor`; replaces `workers`.

    Returns:
        The card of the folder.

    Raises:
        RecipeError: no such environment.
        RecipeError: a factor, split, count or share is not possible.
        DataError: the folder holds another dataset or is in use, or an episode failed.
    """
    if shard_episodes < 1:
        raise RecipeError(f"shard_episodes={shard_episodes} must be at least 1")
    if not 0 <= exploration <= 1:
        raise RecipeError(f"exploration={exploration} is a share of episodes, from 0 to 1")
    if not 0 <= shift <= 1:
        raise RecipeError(f"shift={shift} is a share of half an action's range, from 0 to 1")
    if shift and not exploration:
        raise RecipeError(
            "shift changes exploratory episodes: set exploration too, for example 0.4"
        )
    out, executor = Path(out), executor or LocalExecutor(workers)
    component = catalog().component("environment", environment)
    options = {} if size is None else {"size": size}
    with contextlib.closing(make_environment(component, options)) as simulator:
        card = simulator.card
    for split, count in episodes.items():
        if split not in SPLITS:
            raise RecipeError(f"unknown split {split!r}{suggest(split, SPLITS)}")
        if count < 0:
            raise RecipeError(f"{count} episodes of {split} are impossible: give 0 or more")
    counts: dict[Split, int] = {s: episodes[s] for s in SPLITS if episodes.get(s)}
    if not counts:
        raise RecipeError("no episodes were requested: every split has 0")
    wanted = DatasetCard(
        environment=card,
        splits=counts,
        seed=seed,
        options={"size": list(card.frame_size)},
        factors=dict(factors or {}),
        exploration=exploration,
        shift=shift,
        shard_episodes=shard_episodes,
        versions=package_versions(component.requires),
    )
    # An impossible factor is refused before any worker starts.
    draw_factors(EpisodeSpec(card.name, factors=wanted.factors), card.factors, card.ood_shifts)
    source = functools.partial(simulated, component, exploration=exploration, shift=shift)
    return fill(out, wanted, source, executor, progress=progress)


def parse_episodes(text: str | None, card: EnvironmentCard, split: str = "all") -> dict[Split, int]:
    """The number of episodes per split that ``--split SPLIT --episodes TEXT`` asks for.

    * without a text: the environment's full benchmark, from its card;
    * ``N`` for one split: N episodes;
    * ``N`` for all splits: N training episodes, and test splits in the card's proportion to
      training, at least one each;
    * ``TRAIN,IND,OOD`` for all splits: these numbers; a zero leaves that split out.

    Raises:
        RecipeError: unknown split, malformed numbers, or a card without numbers of episodes.
    """
    if split != "all" and split not in SPLITS:
        raise RecipeError(f"unknown split {split!r}{suggest(split, ('all', *SPLITS))}")
    splits: list[Split] = [name for name in SPLITS if split in ("all", name)]
    if text is None:
        if any(name not in card.episodes for name in splits):
            raise RecipeError(f"{card.name} does not say how many episodes: give --episodes")
        return {name: card.episodes[name] for name in splits}
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if min(numbers, default=-1) < 0 or len(numbers) not in {1, len(splits)}:
        example = "1000 or 1000,100,100 (train,ind_test,ood_test)" if split == "all" else "1000"
        raise RecipeError(f"--episodes {text}: give a number such as {example}")
    if len(numbers) < len(splits):
        full = card.episodes.get("train", 0)
        tests = [round(numbers[0] * card.episodes.get(s, 0) / full) if full else 1 for s in SPLITS]
        numbers += [max(1, number) for number in tests[1:]]
    return dict(zip(splits, numbers, strict=True))


@dataclass(frozen=True)
class ShardTask:
    """One shard to make."""

    source: EpisodeSource
    card: DatasetCard  # of the dataset
    path: Path  # the tar file
    split: Split  # its split
    first: int  # index of its first episode in the split
    episodes: int  # number of its episodes


def make_shard(task: ShardTask, report: Report) -> tuple[Split, ShardRecord]:
    """Write the shard of `task`; reports every episode.

    If a killed command completed the shard but did not record it, it is only described again.

    Returns:
        The split, and the record of the shard for its manifest.

    Raises:
        DataError: an episode could not be made, or the shard could not be written.
    """
    numbers = range(task.first, task.first + task.episodes)
    specs = [task.card.spec(task.split, number) for number in numbers]

    def counted() -> Iterator[Episode | Packed]:
        for episode in task.source(specs):
            yield episode
            report(1)

    record = _existing_shard(task.path, specs)
    if record is not None:
        report(record.episodes)
        return task.split, record
    with writing(task.path):
        fps, versions = task.card.environment.fps, task.card.versions
        return task.split, write_shard(task.path, counted(), fps, versions)


def _existing_shard(path: Path, specs: Sequence[EpisodeSpec]) -> ShardRecord | None:
    """The record of the shard at `path` if it is complete and holds the episodes of `specs`."""
    with contextlib.suppress(DataError):
        reader = open_shard(path)
        specs_of_shard = [reader.about(position)["spec"] for position in range(len(reader))]
        if specs_of_shard == json.loads(json.dumps([spec.to_dict() for spec in specs])):
            return ShardRecord.of_file(path, specs[0].index)
    return None


def fill(
    out: Path,
    wanted: DatasetCard,
    source: EpisodeSource,
    executor: Executor,
    *,
    progress: bool = True,
) -> DatasetCard:
    """Make the shards of the dataset `wanted` that the folder `out` does not hold yet.

    Its episodes come from `source`, see `ShardTask`; everything else is as in `generate`.

    Raises:
        DataError: the folder holds another dataset, is in use, or a shard could not be made.
    """
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        if not (out / LOCK).exists():  # with a lock, a command may be about to write the card
            _refuse_other_files(out)
    with writing(out), held(out):
        _refuse_other_files(out)
        remove_partial(out)
        there = DatasetCard.read(out) if (out / CARD).exists() else wanted
        differences = there.differences(wanted)
        if others := [
            difference for difference in differences if not difference.startswith("versions.")
        ]:
            raise other_dataset(out, others)
        for split in wanted.splits:
            remove_partial(out / split)
        manifests: dict[Split, Manifest] = {s: Manifest(out / s) for s in wanted.splits}
        tasks = list(_missing_shards(out, wanted, source, manifests))
        splits = _in_order({**there.splits, **wanted.splits})
        environment = wanted.environment.completed_by(there.environment)
        joined = replace(there, environment=environment, splits=splits)
        if tasks:
            if differences:  # other versions matter only if shards are still to be made
                raise other_dataset(out, differences)
            joined.write(out)  # first, so that a folder with any content has a card
            for split in wanted.splits:
                (out / split).mkdir(exist_ok=True)
            total, todo = sum(wanted.splits.values()), sum(task.episodes for task in tasks)
            name = wanted.environment.name
            try:
                with progress_bar(name, total, done=total - todo, shown=progress) as report:
                    for split, record in executor.run(make_shard, tasks, report):
                        manifests[split].add(record)
            finally:
                for split in manifests:
                    remove_partial(out / split)  # left by workers that died
        statistics, checksums = dict(joined.actions), dict(joined.checksums)
        for split, manifest in manifests.items():
            manifest.finish()
            statistics[split] = action_statistics(manifest.ordered())
            checksums[split] = manifest.checksum()
        card = replace(joined, actions=_in_order(statistics), checksums=_in_order(checksums))
        card.write(out)
        write_readme(out, card)
        return card


def _refuse_other_files(out: Path) -> None:
    names = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    if names and CARD not in names:
        raise DataError(
            f"{out} holds other files ({names[0]}) and no dataset: choose another --out"
        )


def _in_order(values: Mapping[Split, Any]) -> dict[Split, Any]:
    return {split: values[split] for split in SPLITS if split in values}


def _missing_shards(
    out: Path, card: DatasetCard, source: EpisodeSource, manifests: Mapping[Split, Manifest]
) -> Iterator[ShardTask]:
    for split, manifest in manifests.items():
        for number, first in enumerate(range(0, card.splits[split], card.shard_episodes)):
            path = (out / split / shard_name(number)).absolute()  # other nodes may write it
            if manifest.has(path.name):
                continue
            if path.name in manifest.records:
                path.unlink(missing_ok=True)  # not the file that was recorded
            count = min(card.shard_episodes, card.splits[split] - first)
            yield ShardTask(source, card, path, split, first, count)
