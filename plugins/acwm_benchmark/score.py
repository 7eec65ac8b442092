"""`score_predictions`: what any program predicted of tasks, scored as `acwm evaluate` scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from acwm_benchmark.model import HandedIn
from acwm_benchmark.predictions import Predictions, find_predictions
from acwm_benchmark.tasks import BENCHMARK, BenchmarkWorld, Tasks
from acwm_benchmark.truth import truth_beside, truth_of
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.clips import Predictor
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.evaluate import Entrant, evaluate_clips, evaluator_of
from acwm_core.evaluation.protocol import published_for
from acwm_core.evaluation.results import FOLDER, Summary
from acwm_core.files import inside, writing
from acwm_core.recipe.check import check_section
from acwm_core.recipe.trust import recipes_are_trusted, refuse_code
from acwm_interventions.evaluate import STUDIES
from acwm_report.entry import Entry, read_entry


def score_predictions(
    predictions: str | Path,
    tasks: str | Path,
    worlds: Sequence[str] = (),
    *,
    data: str | Path | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    follow_links: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> dict[str, Summary]:
    """Score predictions of the tasks that `export_tasks` wrote.

    Writes ``OUT/WORLD/evaluation``, which reports, comparisons and leaderboards take like a run.
    Everything is measured that needs no network: all rows but ``shuffled``; ``codec`` is what the
    codec of lossy videos makes of the truth.

    Args:
        predictions: the folder with predictions, and with ``entry.yaml`` if there is one.
        tasks: the folder of tasks.
        worlds: the worlds to score; all by default.
        data: the true test data: a dataset, or a folder with one per world. By default
            ``TASKS-truth``, where it is simulated if it is missing.
        out: the folder to write to; ``scores/NAME`` of the folder of predictions by default.
        overwrite: replace results of other tasks.
        follow_links: whether predictions may be links that lead out of their folder, so that they
            may be another's.
        workers: processes that simulate, one per core by default.
        progress: show progress bars.

    Returns:
        The summary of each world.

    Raises:
        DataError: predictions are missing or wrong (a sentence for each names its clip), or the
            test data is not that of the tasks.
    """
    folder, given = Path(predictions), Tasks(tasks)
    if not folder.is_dir():
        raise DataError(f"there is no folder {folder}")
    entry, chosen = read_entry(folder), given.worlds(worlds)
    found = [
        find_predictions(folder, world, given.of(world.name), follow_links=follow_links)
        for world in chosen
    ]
    for each in found:
        each.check()
    home = Path(out) if out else Path("scores", folder.resolve().name)
    place = truth_beside(given.folder) if data is None else Path(data)
    summaries: dict[str, Summary] = {}
    for world, each in zip(chosen, found, strict=True):
        datasets = truth_of(world, place, workers, progress)
        results = inside(home, world.name) / FOLDER
        with writing(results):
            results.mkdir(parents=True, exist_ok=True)
        summaries[world.name] = _score(given, each, entry, datasets, results, overwrite, progress)
    return summaries


def _score(
    tasks: Tasks,
    predictions: Predictions,
    entry: Entry,
    datasets: dict[str, EpisodeDataset],
    home: Path,
    overwrite: bool,
    progress: bool,
) -> Summary:
    world, model = predictions.world, HandedIn(tasks, predictions)
    rows: list[Predictor] = ["model", "copy", "truth"]
    if predictions.coding is not None:
        rows.insert(2, "codec")
    card = next(iter(datasets.values())).card.environment
    config = with_draws(settings_of(world, tasks), predictions.draws)
    evaluator = evaluator_of(model, card, config, rows)
    facts = {
        "predictions": str(predictions.folder),
        "tasks": str(tasks.folder),
        "predictions_sha256": predictions.checksum,
        "tasks_sha256": tasks.checksum,
        "entry": asdict(entry),
        "parameters": entry.parameters,
        "coding": str(predictions.coding or "lossless"),
    }
    parts = {"env": world.name, "model": entry.name}
    secret = world.seed is None and not world.source
    entrant = Entrant(parts, facts, published_for({"env": world.name}), secret)
    how = {"overwrite": overwrite, "progress": progress}
    return evaluate_clips(evaluator, datasets, home, entrant, studies=STUDIES, **how)


def settings_of(world: BenchmarkWorld, tasks: Tasks) -> EvaluationConfig:
    """The settings of a world's evaluation; those of a file run no code."""
    settings = {"evaluation": world.evaluation}
    origin = tasks.folder / BENCHMARK
    if not recipes_are_trusted():
        refuse_code(settings, origin=origin)
    try:
        return EvaluationConfig(**check_section("evaluation", world.evaluation))
    except RecipeError as error:
        raise DataError(f"{origin}: {error}") from error


def with_draws(config: EvaluationConfig, draws: int) -> EvaluationConfig:
    """The settings for so many draws of each clip.

    Raises:
        DataError: the tasks ask for another number of several.
    """
    if draws > 1 and config.samples not in (1, draws):
        raise DataError(
            f"there are {draws} draws of each task, but the tasks ask for {config.samples}, "
            "or one of a deterministic model"
        )
    return replace(config, samples=max(draws, config.samples))
