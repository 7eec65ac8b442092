"""`evaluate_run`: from a run folder to scores of every test clip; `evaluate_clips`: from others."""

from __future__ import annotations

import contextlib
import shutil
import time
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import magnification
from acwm_core.data.remote import data_folder
from acwm_core.data.video import write_mp4
from acwm_core.env.card import meaning_differences
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import Split
from acwm_core.errors import AcwmWarning, DataError, RecipeError
from acwm_core.evaluation.clips import PREDICTORS, Predictor, sound_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.draws import metrics_for
from acwm_core.evaluation.predict import Evaluator, VideoModel
from acwm_core.evaluation.protocol import PublishedComparison, published_for
from acwm_core.evaluation.provenance import provenance, run_facts
from acwm_core.evaluation.references import scores_with_references
from acwm_core.evaluation.results import FOLDER, SUMMARY, VIDEOS, Score, Summary, unfinished
from acwm_core.evaluation.score import build_metrics, estimator_for, split_available
from acwm_core.evaluation.storage import (
    EPISODES,
    OF_SWEEPS,
    refuse_other_result,
    replacing_result,
    write_scores,
)
from acwm_core.evaluation.study import Findings, Study
from acwm_core.evaluation.summarise import gap, summarise_split
from acwm_core.evaluation.videos import REPORT_PANEL, ClipVideo
from acwm_core.evaluation.views import metrics_of_views
from acwm_core.files import held, writing, written_whole
from acwm_core.model.shapes import float32_by_default
from acwm_core.recipe import Recipe, compose
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder, run_to_write

FEW_TESTS = 64
"""Test episodes of a split that are advised for data without any."""


@dataclass(frozen=True)
class Entrant:
    """What is evaluated, as recorded in its results.

    Attributes:
        parts: see `Summary.parts`.
        facts: what predicted, for `Summary.provenance`.
        published: see `Summary.published`.
        secret: whether the results keep the seed of the test data to themselves.
    """

    parts: dict[str, str]
    facts: dict[str, Any]
    published: PublishedComparison | None = None
    secret: bool = False


@float32_by_default()
def evaluate_run(
    run: str | Path,
    *,
    data: str | Path | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = True,
    studies: Sequence[Study] = (),
) -> Summary:
    """Predict and score every test clip of a run's dataset, and write the results.

    Args:
        run: the run folder, or the name of a trained model.
        data: the data folder; the recipe's by default.
        overrides: changes to the section `evaluation` of the run's recipe.
        out: a folder to write to instead of `run`.
        overwrite: replace a result that was made with other settings, or on other data.
        progress: show a progress bar on the terminal.
        studies: what is measured besides, e.g. with the simulator.

    Returns:
        The content of ``summary.json``, which is in ``RUN/evaluation/`` with ``episodes.parquet``
        and ``videos/``.
    """
    folder = RunFolder(run_to_write(run))
    recipe, evaluator = open_run(folder, overrides)
    facts = run_facts(folder, recipe, evaluator)  # at once: a run that trains writes others soon
    place = data or dataset_of(folder, recipe)
    datasets = open_splits(place, evaluator.config.splits, evaluator.card)
    named = ("codec", "model", "conditioner")
    parts = {"env": evaluator.card.name, **{name: getattr(recipe, name).name for name in named}}
    published = published_for({**parts, "fraction": recipe.data["fraction"]})
    if phrase := unfinished(facts):
        said = f"{folder.path} is {phrase}: these scores are of an unfinished model"
        warnings.warn(said, AcwmWarning, stacklevel=2)
    entrant = Entrant(parts, facts, published)
    home = results_folder(folder, out)
    how = {"overwrite": overwrite, "progress": progress}
    return evaluate_clips(evaluator, datasets, home, entrant, studies=studies, **how)


@float32_by_default()
def evaluate_clips(
    evaluator: Evaluator,
    datasets: Mapping[str, EpisodeDataset],
    home: Path,
    entrant: Entrant,
    *,
    overwrite: bool,
    progress: bool,
    studies: Sequence[Study] = (),
) -> Summary:
    """Predict and score the test clips of these splits, and write the results to `home`.

    The other arguments are those of `evaluate_run`.
    """
    with held(home):
        if not overwrite:
            checksums = {split: episodes.checksum for split, episodes in datasets.items()}
            refuse_other_result(home / SUMMARY, evaluator.config, checksums, OF_SWEEPS)
        return _evaluate(evaluator, datasets, home, entrant, progress, studies)


def results_folder(run: RunFolder, out: str | Path | None) -> Path:
    """The folder for a run's results, created if needed; `out` gets the files reports need."""
    home = run.path if out is None else Path(out)
    with writing(home):
        (home / FOLDER).mkdir(parents=True, exist_ok=True)
        for file in (run.recipe, run.card, run.metrics):
            if out is not None and file.exists() and not (home / file.name).exists():
                with written_whole(home / file.name) as partial:
                    shutil.copyfile(file, partial)
    return home / FOLDER


def _evaluate(
    evaluator: Evaluator,
    datasets: Mapping[str, EpisodeDataset],
    home: Path,
    entrant: Entrant,
    progress: bool,
    studies: Sequence[Study],
) -> Summary:
    started, config = time.monotonic(), evaluator.config
    planned = {
        s: sound_clips(episodes, config, evaluator.given) for s, episodes in datasets.items()
    }
    clips = {split: sound for split, (sound, _) in planned.items()}
    total = sum(evaluator.count_rows(sound) for sound in clips.values())
    total += sum(study.count_rows(evaluator, clips) for study in studies)
    with progress_bar(evaluator, total, progress) as counting:
        scores = {s: scores_with_references(counting, clips[s], datasets[s]) for s in datasets}
        sweeps = {s: counting.sweep(clips[s], datasets[s]) for s in datasets}
        findings = [study.run(counting, clips, datasets) for study in studies]
    videos = [v for s in datasets for v in evaluator.videos(clips[s], datasets[s], scores[s])]
    for finding in findings:
        videos += finding.videos
        scores = {split: [*rows, *finding.scores.get(split, ())] for split, rows in scores.items()}
    summary = _summarise(home, entrant, evaluator, scores, sweeps, findings)
    summary.videos.extend(record for record, _ in videos)
    for _, damaged in planned.values():
        summary.left_out.update(damaged)
    facts = provenance(evaluator, datasets, entrant.facts, secret=entrant.secret)
    summary.provenance.update(facts)
    summary.provenance["seconds"] = round(time.monotonic() - started, 1)
    _write(home, summary, scores, videos)
    return summary


def open_run(folder: RunFolder, overrides: Sequence[str]) -> tuple[Recipe, Evaluator]:
    """The recipe of a run, with `overrides` to its evaluation, and the run's `Evaluator`."""
    bundle = load_run(folder.path)
    for override in overrides:
        if not override.startswith("evaluation."):
            raise RecipeError(
                f"{override!r} is not a setting of the evaluation; it takes overrides such as "
                "evaluation.steps=10"
            )
    recipe = compose(folder.recipe, overrides, sections=["evaluation"])
    config = EvaluationConfig(**recipe.evaluation)
    world_model = bundle.world_model.to(choose_device(config.device))
    return recipe, evaluator_of(world_model, bundle.card, config)


def evaluator_of(
    world_model: VideoModel,
    card: EnvironmentCard,
    config: EvaluationConfig,
    rows: Sequence[Predictor] = PREDICTORS,
) -> Evaluator:
    """An `Evaluator` with the metrics of `config` that can be measured here."""
    if not config.metrics:
        raise RecipeError(
            "evaluation.metrics must name at least one: let the recipe extend base.yaml, "
            "which lists the default metrics, or add evaluation.metrics=[NAME] (see `acwm list "
            "metric`)"
        )
    estimator = estimator_for(card)
    asked = build_metrics(config.metrics, config.metric_options)
    metrics, left_out = split_available(metrics_for(asked, config.samples), card, estimator)
    of_views, too_small = metrics_of_views(metrics, card)
    return Evaluator(
        world_model,
        card,
        {**metrics, **of_views},
        config,
        estimator=estimator,
        left_out={**left_out, **too_small},
        rows=rows,
    )


def open_splits(
    path: str | Path, splits: Sequence[str] | None, card: EnvironmentCard
) -> dict[str, EpisodeDataset]:
    """Open the splits of a data folder, by default the test splits; `card` is the run's card."""
    path = data_folder(path)
    if splits is None:
        splits = [split for split in DatasetCard.read(path).splits if split != "train"]
        if not splits:
            raise DataError(
                f"{path} has no test split: add one, or evaluate on evaluation.splits=[train]"
            )
    datasets = {split: EpisodeDataset(path, cast(Split, split)) for split in splits}
    for dataset in datasets.values():
        check_environment(dataset, card)
    return datasets


def dataset_of(run: RunFolder, recipe: Recipe) -> str:
    """The dataset of a run's recipe.

    Raises:
        DataError: it is not here; says how to simulate its test episodes.
    """
    path: str = recipe.data["path"]
    if ":" in path or (Path(path) / CARD).is_file():
        return path
    tests = _test_card(run, DatasetCard.read(run.card))
    make = "" if tests.source else f"make its test episodes with `{tests.command(path)}`, or "
    raise DataError(f"there is no dataset in {path}: {make}name one with --data")


def _test_card(run: RunFolder, card: DatasetCard) -> DatasetCard:
    """The card of a run's test data: those of its last evaluation, or those of its own data.

    Training data may lack test episodes; then there are `FEW_TESTS` of each split.
    """
    if not card.source:
        with contextlib.suppress(DataError, OSError, LookupError, TypeError):
            last = Summary.load(run.path / FOLDER / SUMMARY).provenance["dataset"]
            if last["seed"] is not None and not last["source"]:
                return card.of_tests(last)
    tests = {split: count for split, count in card.splits.items() if split != "train"}
    return replace(card, splits=tests or {"ind_test": FEW_TESTS, "ood_test": FEW_TESTS})


def check_environment(dataset: EpisodeDataset, card: EnvironmentCard) -> None:
    """Check that a dataset has the rate, the actions and the views that a model was trained on.

    The bounds of recorded actions are those of the recordings, so they may differ.

    Raises:
        DataError: it has others.
    """
    own = dataset.card.environment
    if own.views and card.views and own.views != card.views:
        raise DataError(
            f"{dataset.path} shows the views {', '.join(own.views)}, but the run was trained on "
            f"{', '.join(card.views)}: import it with the same --camera, in the same order"
        )
    ours, theirs = meaning_differences(own, card)
    if not ours and not dataset.card.source and own.action != card.action:
        ours, theirs = ["other bounds of the actions"], ["its own"]
    if ours:
        rate = "resample it (--fps), or " if "frames/s" in ours[0] and dataset.card.source else ""
        raise DataError(
            f"{dataset.path} holds {own.name} with {', '.join(ours)}, but the run was trained on "
            f"{card.name} with {', '.join(theirs)}: {rate}give data of the same environment"
        )
    _report_range(dataset, card)


def _report_range(dataset: EpisodeDataset, card: EnvironmentCard) -> None:
    """Warn of actions beyond those that the model was trained on."""
    spec, of_split = card.action, dataset.card.actions.get(cast(Split, dataset.split), {})
    for name, low, high, least, most in zip(
        spec.names,
        spec.low,
        spec.high,
        of_split.get("min", ()),
        of_split.get("max", ()),
        strict=False,
    ):
        slack = 1e-3 * (high - low)
        if least < low - slack or most > high + slack:
            warnings.warn(
                f"{dataset.split} of {dataset.path} has the action {name} from {least:.3g} to "
                f"{most:.3g}, the model was trained on {low:.3g} to {high:.3g}: beyond "
                "that range it extrapolates",
                AcwmWarning,
                stacklevel=2,
            )


def choose_device(name: str, option: str = "evaluation.device=") -> torch.device:
    """The device with this name, or a `RecipeError`; ``auto`` is a GPU if there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError):
        raise RecipeError(f"{option}{name}: this machine has no such device") from None


def _summarise(
    home: Path,
    entrant: Entrant,
    evaluator: Evaluator,
    scores: Mapping[str, list[Score]],
    sweeps: Mapping[str, Mapping[int, list[Score]]],
    findings: Sequence[Findings],
) -> Summary:
    """The summary of all splits, without videos and provenance."""
    metrics, config, card = evaluator.metrics, evaluator.config, evaluator.card
    inside, outside = scores.get("ind_test"), scores.get("ood_test")
    splits = {
        split: summarise_split(rows, metrics, config.seed, sweeps[split])
        for split, rows in scores.items()
    }
    summary = Summary(
        run=home.resolve().parent.name,
        parts=entrant.parts,
        metrics={name: metric.info for name, metric in metrics.items()},
        headline=evaluator.headline,
        splits=splits,
        gap=gap(inside, outside, metrics, config.seed) if inside and outside else {},
        environment={
            **{name: getattr(card, name) for name in ("name", "summary", "fps", "citation")},
            "action": asdict(card.action),
            **({"views": card.view_names} if card.views else {}),
        },
        protocol=config.protocol,
        left_out={**evaluator.left_out},
        published=entrant.published,
    )
    for finding in findings:
        splits = {s: replace(own, **finding.splits.get(s, {})) for s, own in summary.splits.items()}
        summary = replace(summary, splits=splits, **finding.summary)
        summary.left_out.update(finding.left_out)
    return summary


def _write(
    folder: Path,
    summary: Summary,
    scores: Mapping[str, list[Score]],
    videos: Sequence[ClipVideo],
) -> None:
    height = summary.provenance["dataset"]["frame_size"][0]
    with writing(folder), replacing_result(folder) as new:
        for record, frames in videos:
            fps = summary.environment["fps"]
            write_mp4(new / VIDEOS / record.file, frames, fps, magnification(height, REPORT_PANEL))
        write_scores(new / EPISODES, [score for split in scores.values() for score in split])
        summary.write(new)
    home = folder / VIDEOS
    for old in {*home.glob("*.mp4")} - {home / record.file for record, _ in videos}:
        old.unlink()


@contextmanager
def progress_bar(evaluator: Evaluator, total: int, visible: bool) -> Generator[Evaluator]:
    """Show a progress bar of `total` rows; yields an evaluator that advances it."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task("evaluating", total=total)
        yield replace(evaluator, advance=partial(bar.advance, task))
