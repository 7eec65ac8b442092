"""`export_tasks`: the test clips of worlds as tasks, which hold nothing of the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from acwm_benchmark.tasks import (
    BENCHMARK,
    README,
    SUMS,
    BenchmarkTask,
    BenchmarkWorld,
    Tasks,
    write_index,
)
from acwm_benchmark.truth import TESTS, datasets_in, simulate, truth_beside
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.clips import Clip, plan_clips, read_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.evaluate import open_splits
from acwm_core.files import inside, made_whole, writing
from acwm_core.model.world_model import CLIP_FRAMES
from acwm_core.plugins import catalog
from acwm_core.recipe.check import check_section
from acwm_core.recipe.compose import read_recipe, recipe_folder
from acwm_interventions.counterfactual import branches_of
from acwm_interventions.interventions import COUNTERFACTUAL, asked_clips, simulator_of

PUBLIC = 0
"""The seed of the public benchmark; any other is kept secret."""

USUAL_EPISODES = 64
"""Number of episodes of each test split, if neither a person nor the protocol says another."""

ALL = 0
"""Stands for all episodes."""

OF_NETWORKS: dict[str, Any] = {"device": "cpu"}
"""Settings of which predictions that were made elsewhere know nothing."""


@dataclass(frozen=True)
class Given:
    """What a participant is given of one clip."""

    id: str
    clip: Clip
    frames: NDArray[np.uint8]  # `[K, H, W, 3]`
    actions: NDArray[np.float32]  # `[T, A]`
    branch: bool = False


def export_tasks(
    worlds: Sequence[str],
    out: str | Path,
    *,
    data: str | Path | None = None,
    size: int | tuple[int, int] | None = None,
    episodes: int | None = None,
    seed: int = PUBLIC,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    progress: bool = True,
) -> Tasks:
    """Write the tasks of worlds to the folder `out`.

    Args:
        worlds: registered names of environments; by default all datasets in `data`.
        out: a new folder.
        data: the test data: a dataset, or a folder with one per world. By default it is simulated
            into the folder ``OUT-truth``.
        size: frame size of simulated data; by default the environment's.
        episodes: number of episodes of each test split, or `ALL`; by default the protocol's, or
            else `USUAL_EPISODES`.
        seed: seed of simulated data. Participants learn it only if it is `PUBLIC`.
        overrides: settings of the evaluation, such as ``evaluation.context_frames=5``.
        workers: processes that simulate, one per core by default.
        progress: show a progress bar.

    Raises:
        RecipeError: an override is no setting of an evaluation, or there is no world.
        DataError: `out` exists, or there is no such data.
    """
    out = Path(out)
    if out.exists() and any(out.iterdir()):
        raise DataError(f"{out} is not empty: choose another --out, or delete it first")
    config = evaluation_config(overrides)
    if episodes is None:
        episodes = config.episodes or USUAL_EPISODES
    config = replace(config, episodes=episodes or None)
    place = truth_beside(out) if data is None else Path(data)
    if data is None:
        for name in worlds:
            _simulate(name, place / name, size, episodes, seed, workers, progress)
    there = datasets_in(place) if place.exists() else {}
    if missing := [name for name in worlds if name not in there]:
        raise DataError(f"{place} holds no dataset of {', '.join(missing)}")
    chosen = {name: there[name] for name in (worlds or there)}
    if not chosen:
        raise RecipeError("there is no world to export: name one, or a folder of --data")
    with made_whole(out) as folder, writing(out):
        made = [
            _export_world(path, folder, config, seed if data is None else None)
            for path in chosen.values()
        ]
        known = {world.name: world for world, _ in made}
        tasks = [task for _, each in made for task in each]
        _write_readme(folder, known, tasks)
        write_index(folder, known, tasks)
    return Tasks(out)


def evaluation_config(overrides: Sequence[str]) -> EvaluationConfig:
    """The usual settings of an evaluation with `overrides`."""
    for override in overrides:
        if not override.startswith("evaluation."):
            raise RecipeError(
                f"{override!r} is not a setting of the evaluation; tasks take settings such as "
                "evaluation.context_frames=5"
            )
    settings = read_recipe(recipe_folder() / "base.yaml", overrides)["evaluation"]
    checked = EvaluationConfig(**check_section("evaluation", {**settings, **OF_NETWORKS}))
    return replace(checked, context_frames=checked.context_frames or 1)


def _simulate(name: str, out: Path, size: Any, episodes: int, seed: int, *more: Any) -> None:
    """Simulate as many test episodes of a world as are asked for."""
    component = catalog().component("environment", name)
    with contextlib.closing(make_environment(component, {})) as environment:
        usual = environment.card.episodes
    if episodes == ALL and not usual:
        raise RecipeError(f"{name} does not say how many episodes it has: give --episodes")
    counts = {split: episodes or usual[split] for split in TESTS}
    simulate(name, out, counts, size, seed, *more)


def _export_world(
    path: Path, folder: Path, config: EvaluationConfig, seed: int | None
) -> tuple[BenchmarkWorld, list[BenchmarkTask]]:
    """Write the tasks of one dataset; `seed` is None if the data was not simulated for them."""
    card = DatasetCard.read(path)
    environment, name = card.environment, card.environment.name
    datasets = open_splits(path, config.splits, environment)
    given = config.context_frames or 1
    clips = {s: plan_clips(s, each.lengths, config, given) for s, each in datasets.items()}
    frames = given + CLIP_FRAMES - 1
    inside(folder, name).mkdir()
    tasks = [_write(folder, name, each) for each in _of_clips(name, clips, datasets)]
    branches = [
        _write(folder, name, each) for each in _of_branches(name, clips, datasets, config, frames)
    ]
    whole = all(len(each) <= (config.episodes or len(each)) for each in datasets.values())
    config = replace(
        config,
        episodes=None if whole else config.episodes,  # then tasks of all are called so
        counterfactual_episodes=config.counterfactual_episodes if branches else 0,
    )
    world = BenchmarkWorld(
        name=name,
        summary=environment.summary,
        size=environment.frame_size,
        fps=environment.fps,
        actions=asdict(environment.action),
        evaluation=config.to_dict(),
        checksums={split: each.checksum for split, each in datasets.items()},
        episodes={split: len(each) for split, each in datasets.items()},
        branch_frames=frames,
        source={n: card.source[n] for n in ("kind", "name") if n in card.source},
        seed=seed if seed == PUBLIC else None,
    )
    return world, [*tasks, *branches]


def _of_clips(
    world: str, clips: Mapping[str, Sequence[Clip]], datasets: Mapping[str, EpisodeDataset]
) -> Iterator[Given]:
    for split, each in clips.items():
        for clip, episode in read_clips(each, datasets[split]):
            yield Given(_name(world, clip), clip, episode.video[: clip.given], episode.actions)


def _of_branches(
    world: str,
    clips: Mapping[str, Sequence[Clip]],
    datasets: Mapping[str, EpisodeDataset],
    config: EvaluationConfig,
    frames: int,
) -> Iterator[Given]:
    """Other actions from the same frames, and first the clip's own, cut to as many frames."""
    asked = asked_clips(config, clips)[COUNTERFACTUAL]
    first = next(iter(datasets.values()))
    if not any(asked.values()) or not config.counterfactual_metrics or first.card.source:
        return
    with contextlib.closing(simulator_of(first)) as environment:
        for split, few in asked.items():
            for clip, whole in read_clips(few, datasets[split]):
                episode, branches = branches_of(environment, clip, whole, datasets[split], frames)
                shown = episode.video[: clip.given]
                rows = [episode.actions, *(branch.actions for branch in branches)]
                for number, actions in enumerate(rows):
                    if not np.array_equal(actions, whole.actions):  # else it is the clip itself
                        name = f"{_name(world, clip)}-branch-{number:02d}"
                        yield Given(name, clip, shown, actions, branch=True)


def _name(world: str, clip: Clip) -> str:
    start = f"-{clip.start:04d}" if clip.start else ""
    return f"{world}/{clip.split}-{clip.episode:06d}{start}"


def _write(folder: Path, world: str, given: Given) -> BenchmarkTask:
    several = len(given.frames) > 1
    images = [f"{given.id}{f'-{n}' * several}.png" for n in range(len(given.frames))]
    for name, frame in zip(images, given.frames, strict=True):
        Image.fromarray(frame).save(folder / name)
    actions = f"{given.id}.npz"
    np.savez_compressed(folder / actions, actions=given.actions)
    return BenchmarkTask(
        id=given.id,
        world=world,
        frames=len(given.actions),
        given=len(given.frames),
        images=images,
        actions=actions,
        seed=given.clip.seed,
        branch=given.branch,
    )


def _write_readme(
    folder: Path, worlds: Mapping[str, BenchmarkWorld], tasks: Sequence[BenchmarkTask]
) -> None:
    text = resources.files("acwm_benchmark").joinpath("tasks.md.j2").read_text("utf-8")
    page = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(text)
    counts = {name: sum(task.world == name for task in tasks) for name in worlds}
    first = tasks[0]
    (folder / README).write_text(
        page.render(worlds=worlds, counts=counts, first=first, sums=SUMS, benchmark=BENCHMARK),
        encoding="utf-8",
    )
