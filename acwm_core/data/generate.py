"""Generate a dataset: many episodes, by many workers, resumable, with the same bytes every time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acwm_core.catalog import catalog
from acwm_core.data.card import DatasetCard, current_versions
from acwm_core.data.filling import fill
from acwm_core.data.simulate import make_environment
from acwm_core.data.tasks import ShardTask, make_shard
from acwm_core.environment import EnvironmentCard
from acwm_core.episode import SPLITS, EpisodeSpec, FactorSetting, Split, draw_factors
from acwm_core.errors import RecipeError, suggest
from acwm_core.executors import Executor, LocalExecutor
from acwm_core.registry import Component

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
    workers: int | None = None,
    executor: Executor | None = None,
    shard_episodes: int = SHARD_EPISODES,
    progress: bool = True,
) -> DatasetCard:
    """Simulate episodes of an environment into the data folder `out`.

    The bytes depend on the arguments other than `workers`, `executor` and `progress`, on the
    versions in the card, and on nothing else. Finished shards are kept, so the same call goes on
    where a killed one ended, and a call for another split adds it to the folder.

    Args:
        environment: registered name.
        out: the folder; created with its parents.
        episodes: how many per split; `parse_episodes` reads them from the command line.
        seed: seed of the dataset.
        size: frame size, a side or ``(H, W)``; the environment's by default.
        factors: factor settings that override the splits', e.g. ``{"friction": "ood"}``.
        workers: processes, one per core by default; 0 simulates in this process.
        executor: runs the shards elsewhere, e.g. a `RayExecutor`; takes the place of `workers`.
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
    out, executor = Path(out), executor or LocalExecutor(workers)
    component = catalog().component("environment", environment)
    card = _environment_card(component, {} if size is None else {"size": size})
    wanted = DatasetCard(
        environment=card,
        splits=_checked_counts(episodes),
        seed=seed,
        options={"size": list(card.frame_size)},
        factors=dict(factors or {}),
        shard_episodes=shard_episodes,
        versions=current_versions(component),
    )
    _check_factors(wanted)

    def task(path: Path, split: Split, first: int, count: int) -> ShardTask:
        return ShardTask(
            path.absolute(),  # other nodes may run it
            component,
            split,
            first,
            count,
            wanted.seed,
            wanted.factors,
            wanted.options,
            wanted.versions,
        )

    return fill(out, wanted, task, make_shard, executor, progress=progress)


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


def _environment_card(component: Component, options: Mapping[str, Any]) -> EnvironmentCard:
    environment = make_environment(component, options)
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
