"""Generalisation by severity: error against the value of a factor, away from training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.remote import data_folder
from acwm_core.env.episode import EpisodeSpec, Factor, Split
from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import Predictor, plan_clips
from acwm_core.evaluation.evaluate import open_run, progress_bar, results_folder
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.provenance import provenance, run_facts
from acwm_core.evaluation.results import write_json
from acwm_core.evaluation.storage import refuse_other_result
from acwm_core.evaluation.summarise import summarise
from acwm_core.files import inside
from acwm_core.training.run_folder import RunFolder, run_to_write
from acwm_interventions.interventions import simulator_of
from acwm_severity.curves import (
    SEVERITY,
    SeverityCurve,
    SeverityPoint,
    Sweep,
    parse_sweep,
)

SPLIT: Split = "ind_test"
"""Split in which all other factors are drawn as in training, the same for every value."""


def sweep_severity(
    run: str | Path,
    texts: Sequence[str],
    *,
    data: str | Path | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> Iterator[SeverityCurve]:
    """Evaluate a run at several values of factors, on episodes generated for this purpose.

    Everything else stays as in the split ``ind_test`` of the dataset: its seed, frame size and
    factors. So the episodes at two values start alike as far as the factor allows. Writes
    ``RUN/evaluation/severity/``; episodes that already exist there are not simulated again.

    Args:
        run: the run folder, or the name of a trained model.
        texts: factors and their values, see `parse_sweep`.
        data: the data folder; the recipe's by default.
        overrides: changes to the section `evaluation` of the run's recipe.
        out: a folder to write to instead of `run`.
        overwrite: replace a curve that was made with other settings.
        workers: processes that simulate, one per core by default; 0 simulates in this process.
        progress: show progress bars on the terminal.

    Returns:
        An iterator with one curve per text, computed on demand; all texts are checked first.
    """
    folder = RunFolder(run_to_write(run))
    recipe, evaluator = open_run(folder, overrides)
    path = data_folder(data or recipe.data["path"])
    card = DatasetCard.read(path)
    sweeps = _parsed(texts, card.environment.factors)
    _try_out(EpisodeDataset(path, next(iter(card.splits))), sweeps)
    home = results_folder(folder, out) / SEVERITY
    for sweep in () if overwrite else sweeps:
        values = dict.fromkeys(f"{sweep.factor.name}={value}" for value in sweep.values)
        refuse_other_result(inside(home, f"{sweep.factor.name}.json"), evaluator.config, values)

    def curve(sweep: Sweep) -> SeverityCurve:
        factor, count = sweep.factor, evaluator.config.severity_episodes
        datasets = _generated(card, sweep, home / f"{count}-episodes", count, workers, progress)
        made = SeverityCurve(
            factor=factor.name,
            description=factor.description,
            unit=factor.unit,
            kind=factor.kind,
            train=list(factor.train),
            ood=list(factor.ood),
            episodes=count,
            metrics={n: m.info for n, m in evaluator.metrics.items()},
            headline=evaluator.headline,
            points=_points(evaluator, sweep, datasets, progress),
            left_out=list(sweep.left_out),
            provenance=provenance(evaluator, datasets, run_facts(folder, recipe, evaluator)),
        )
        write_json(inside(home, f"{made.factor}.json"), made)
        return made

    return map(curve, sweeps)


def _points(
    evaluator: Evaluator, sweep: Sweep, datasets: Mapping[str, EpisodeDataset], progress: bool
) -> list[SeverityPoint]:
    """Score the model at every value; `datasets` hold its episodes, in the order of the values."""
    config, factor = evaluator.config, sweep.factor
    rows: list[Predictor] = [each for each in evaluator.predictors if each != "shuffled"]
    plans = [plan_clips(SPLIT, d.lengths, config, evaluator.given) for d in datasets.values()]
    total = sum(evaluator.count_rows(each, rows) for each in plans)
    points: list[SeverityPoint] = []
    with progress_bar(evaluator, total, progress) as shown:
        for value, clips, episodes in zip(sweep.values, plans, datasets.values(), strict=True):
            scores = shown.scores(clips, episodes, rows)
            found = summarise(scores, evaluator.metrics, config.seed)
            level = factor.severity(value)
            points.append(SeverityPoint(value, level, level == 0, found, episodes.checksum))
    return points


def _generated(
    card: DatasetCard, sweep: Sweep, home: Path, count: int, workers: int | None, progress: bool
) -> dict[str, EpisodeDataset]:
    datasets: dict[str, EpisodeDataset] = {}
    for value in sweep.values:
        name = f"{sweep.factor.name}={value}"
        place = inside(home, name)
        generate(
            card.environment.name,
            place,
            episodes={SPLIT: count},
            seed=card.seed,
            size=card.environment.frame_size,
            factors={**card.factors, sweep.factor.name: value},
            workers=workers,
            shard_episodes=4,  # so that few episodes keep several workers busy
            progress=progress,
        )
        datasets[name] = EpisodeDataset(place, SPLIT)
    return datasets


def _parsed(texts: Sequence[str], factors: Sequence[Factor]) -> list[Sweep]:
    """Parse the sweeps; a factor may appear only once, or its last curve would replace others."""
    sweeps = [parse_sweep(text, factors) for text in texts]
    for name, times in Counter(sweep.factor.name for sweep in sweeps).items():
        if times > 1:
            raise RecipeError(f"{name} is swept {times} times: list all its values in one sweep")
    return sweeps


def _try_out(source: EpisodeDataset, sweeps: Sequence[Sweep]) -> None:
    """Start an episode with each value, so that an impossible value is refused right away."""
    environment, card = simulator_of(source), source.card
    name = environment.card.name
    try:
        for factor, value in [(sweep.factor.name, v) for sweep in sweeps for v in sweep.values]:
            factors = {**card.factors, factor: value}
            spec = EpisodeSpec(name, SPLIT, 0, card.seed, factors, card.options)
            try:
                environment.reset(options={"spec": spec})
            except RecipeError:
                raise  # its message already says what is wrong
            except Exception as error:  # simulators may raise anything
                raise RecipeError(
                    f"factors.{factor}={value} is not possible: {name} cannot start with it "
                    f"({type(error).__name__}: {error})"
                ) from error
    finally:
        environment.close()
