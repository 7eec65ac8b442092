"""Generate a dataset: many episodes, by many workers, resumable, with the same bytes every time."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from acwm_core.catalog import catalog
from acwm_core.data.atomic import held, remove_partial
from acwm_core.data.card import CARD, DatasetCard, current_versions
from acwm_core.data.executors import Report, make_executor
from acwm_core.data.manifest import Manifest, action_statistics, shard_name
from acwm_core.data.simulate import make_environment
from acwm_core.data.tasks import ShardTask, make_shard
from acwm_core.environment import EnvironmentCard
from acwm_core.episode import SPLITS, EpisodeSpec, FactorSetting, Split, draw_factors
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.registry import Part

SHARD_EPISODES = 32
"""Episodes per shard: a few MB at 64×64, a few tens at 240×240."""

Manifests = dict[Split, Manifest]
Value = TypeVar("Value")


def generate(
    environment: str,
    out: str | Path,
    *,
    episodes: Mapping[Split, int],
    seed: int = 0,
    size: int | tuple[int, int] | None = None,
    factors: Mapping[str, FactorSetting] | None = None,
    workers: int | None = None,
    shard_episodes: int = SHARD_EPISODES,
    progress: bool = True,
) -> DatasetCard:
    """Simulate episodes of an environment into the data folder `out`.

    The bytes depend on the arguments other than `workers` and `progress`, on the versions in the
    card, and on nothing else. Finished shards are kept, so the same call goes on where a killed
    one ended, and a call for another split adds it to the folder.

    Args:
        environment: registered name.
        out: the folder; created with its parents.
        episodes: how many per split; `parse_episodes` reads them from the command line.
        seed: seed of the dataset.
        size: frame size, a side or ``(H, W)``; the environment's by default.
        factors: factor settings that override the splits', e.g. ``{"friction": "ood"}``.
        workers: processes, one per core by default; 0 simulates in this process.
        shard_episodes: episodes per shard.
        progress: show a progress bar on the terminal.

    Returns:
        The card of the folder.

    Raises:
        UnknownNameError: no such environment.
        RecipeError: a factor, split or count that is not possible.
        DataError: the folder holds another dataset, is in use, or an episode failed.
    """
    if shard_episodes < 1:
        raise RecipeError(f"shard_episodes={shard_episodes} must be at least 1")
    out, executor = Path(out), make_executor(workers)
    part = catalog().part("environment", environment)
    card = _environment_card(part, {} if size is None else {"size": size})
    wanted = DatasetCard(
        environment=card,
        splits=_checked_counts(episodes),
        seed=seed,
        options={"size": list(card.frame_size)},
        factors=dict(factors or {}),
        shard_episodes=shard_episodes,
        versions=current_versions(part),
    )
    _check_factors(wanted)
    _make_folder(out)
    with held(out):
        there = DatasetCard.read(out) if (out / CARD).exists() else wanted
        differences = there.differences(wanted)
        _refuse(out, [each for each in differences if not each.startswith("versions.")])
        manifests: Manifests = {split: _open_manifest(out, split) for split in wanted.splits}
        tasks = _missing_shards(out, part, wanted, manifests)
        joined = replace(there, splits=_in_order({**there.splits, **wanted.splits}))
        if tasks:
            _refuse(out, differences)  # other versions matter only to what is still to be made
            joined.write(out)  # a folder with shards always says what they are
            with _progress_bar(wanted, tasks, progress) as report:
                for split, record in executor.run(make_shard, tasks, report):
                    manifests[split].add(record)
        return _finish(out, joined, manifests)


def parse_episodes(text: str | None, card: EnvironmentCard, split: str = "all") -> dict[Split, int]:
    """The episodes per split that ``--split SPLIT --episodes TEXT`` asks for.

    * without a text: the environment's full benchmark, as its card says;
    * ``N`` for one split: N episodes;
    * ``N`` for all splits: N training episodes, and test splits in the card's proportion to
      training, at least one each;
    * ``TRAIN,IND,OOD`` for all splits: these numbers; a zero leaves that split out.

    Raises:
        RecipeError: unknown split, no such numbers, or a card that leaves them open.
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


def _environment_card(part: Part, options: Mapping[str, Any]) -> EnvironmentCard:
    environment = make_environment(part, options)
    try:
        return environment.card
    finally:
        environment.close()


def _checked_counts(episodes: Mapping[Split, int]) -> dict[Split, int]:
    for split, count in episodes.items():
        if split not in SPLITS:
            raise RecipeError(f"unknown split {split!r}{suggest(split, SPLITS)}")
        if count < 0:
            raise RecipeError(f"{count} episodes of {split} cannot be made")
    counts: dict[Split, int] = {s: episodes[s] for s in SPLITS if episodes.get(s)}
    if not counts:
        raise RecipeError("there are no episodes to make: every split has 0")
    return counts


def _check_factors(card: DatasetCard) -> None:
    """Refuse an impossible factor before any worker starts."""
    environment = card.environment
    spec = EpisodeSpec(environment.name, factors=card.factors)
    draw_factors(spec, environment.factors, environment.ood_shifts)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise DataError(f"cannot make the folder {out} ({error.strerror})") from error
    if names and CARD not in names:
        raise DataError(
            f"{out} holds other files ({names[0]}) and no dataset: choose another --out"
        )


def _refuse(out: Path, differences: list[str]) -> None:
    if differences:
        raise DataError(
            f"{out} holds another dataset: {'; '.join(differences)}. Choose another --out, "
            "or delete the folder to make it anew"
        )


def _in_order(values: Mapping[Split, Value]) -> dict[Split, Value]:
    return {split: values[split] for split in SPLITS if split in values}


def _open_manifest(out: Path, split: Split) -> Manifest:
    folder = out / split
    folder.mkdir(exist_ok=True)
    remove_partial(folder)
    return Manifest(folder)


def _missing_shards(
    out: Path, part: Part, card: DatasetCard, manifests: Manifests
) -> list[ShardTask]:
    tasks: list[ShardTask] = []
    for split in manifests:
        for number, first in enumerate(range(0, card.splits[split], card.shard_episodes)):
            path = out / split / shard_name(number)
            if manifests[split].has(path.name):
                continue
            if path.name in manifests[split].records:
                path.unlink(missing_ok=True)  # not the file that was recorded
            episodes = min(card.shard_episodes, card.splits[split] - first)
            tasks.append(
                ShardTask(
                    path,
                    part,
                    split,
                    first,
                    episodes,
                    card.seed,
                    card.factors,
                    card.options,
                    card.versions,
                )
            )
    return tasks


@contextlib.contextmanager
def _progress_bar(card: DatasetCard, tasks: list[ShardTask], shown: bool) -> Generator[Report]:
    """A bar over all episodes with the rate and the remaining time of this run."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    todo = sum(task.episodes for task in tasks)
    total = sum(card.splits.values())
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes {task.fields[rate]}"),
        Remaining(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as bar:
        name = card.environment.name
        task_id = bar.add_task(name, total=total, completed=total - todo, rate="")

        def report(episodes: int) -> None:
            bar.advance(task_id, episodes)
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
            bar.update(task_id, rate=f"{speed:.1f}/s" if speed else "")

        yield report


def _finish(out: Path, card: DatasetCard, manifests: Manifests) -> DatasetCard:
    statistics = dict(card.actions)
    for split, manifest in manifests.items():
        manifest.finish()
        statistics[split] = action_statistics(manifest.ordered())
    card = replace(card, actions=_in_order(statistics))
    card.write(out)
    return card
