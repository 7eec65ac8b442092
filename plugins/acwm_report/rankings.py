"""Tables and charts of how well a run's model ranks policies."""

from __future__ import annotations

from pathlib import Path

from acwm_core.files import read_json
from acwm_planning.policies.ranking import RANKING_FILE, RANKING_FOLDER, Ranking
from acwm_report.figures import Chart, Curve
from acwm_report.run import EvaluatedRun, result_files
from acwm_report.table import PLAIN, Cell, Column, Row, Table
from acwm_report.titles import counted

JUDGES = {
    "model": ("Model", "an estimator's readings of its predictions"),
    "estimator": ("Estimator alone", "its readings of the true pictures: the upper bound"),
}
"""Title and explanation of each judge that scores policies."""


def rankings(run: EvaluatedRun) -> list[Ranking]:
    """The rankings made with the evaluated weights, in order of their tasks."""
    return rankings_of(run.folder, run.summary.predictor)


def rankings_of(run: Path, weights: str) -> list[Ranking]:
    """The rankings in a run folder made with weights of this SHA-256."""
    files = result_files(run, f"{RANKING_FOLDER}/*/{RANKING_FILE}")
    stored = [read_json(path, Ranking, "a ranking of policies") for path in files]
    return [ranking for ranking in stored if ranking.weights == weights]


def ranking_tables(run: EvaluatedRun) -> list[Table]:
    """A `ranking_table` per task."""
    return [ranking_table(ranking) for ranking in rankings(run)]


def ranking_table(ranking: Ranking) -> Table:
    """How well policy scores agree with the simulator's, and the regret of choices."""
    columns = [Column(title, better="↑") for title in ("Pearson", "Spearman", "Kendall")]
    columns += [Column("MMRV", better="↓"), Column("Optimism")]
    rows: list[Row] = []
    for judge, (title, note) in JUDGES.items():
        for score, by in ranking.agreement[judge].items():
            cells = [Cell.of(v, PLAIN) for v in (by.pearson, by.spearman, by.kendall, by.mmrv)]
            cells.append(Cell.of(by.optimism, PLAIN, signed=True))
            score_title = "success" if score == "success" else "return"
            rows.append(Row(f"{title}, {score_title}", cells, note, strong=judge == "model"))
    choices = ranking.decisions.get("model")
    lost = (
        ""
        if choices is None
        else (
            f"Regret: {_text(choices.regret.value)} {ranking.unit} per action by the model’s "
            f"choice, {_text(choices.chance.value)} at random, "
            f"over {counted(choices.starts, 'start')}. "
        )
    )
    caption = f"{lost}{_unread(ranking)}Returns are negative sums of distances in {ranking.unit}."
    policies = f"{len(ranking.policies)} polic{'y' if len(ranking.policies) == 1 else 'ies'}"
    head = f"{ranking.task} · {policies}, {counted(ranking.episodes, 'episode')} of each"
    return Table(head, columns, rows, "Judged by", caption, f"policies-{ranking.task}")


def ranking_charts(run: EvaluatedRun) -> list[Chart]:
    """Per task: the return of each policy in the model against its return in the simulator."""
    charts: list[Chart] = []
    for ranking in rankings(run):
        true, seen = (
            [policy.returns[judge] for policy in ranking.policies] for judge in ("truth", "model")
        )
        ends = [min(true + seen), max(true + seen)]
        curves = [Curve("", "muted", ends, ends, "raw"), Curve("", "model", true, seen, ".")]
        labels = "true return", "return in the model"
        charts.append(Chart(ranking.task, f"{run.key}-policies-{ranking.task}", curves, *labels))
    return charts


def _unread(ranking: Ranking) -> str:
    """A sentence on the episodes without an estimated distance; empty if none."""
    pictures = {"model": "predictions", "estimator": "true pictures"}
    counts = {judge: sum(p.unread.get(judge, 0) for p in ranking.policies) for judge in pictures}
    counted = [f"{count} of {pictures[judge]}" for judge, count in counts.items() if count]
    if not counted:
        return ""
    episodes = len(ranking.policies) * ranking.episodes
    return (
        f"The estimator found no distance in {' and '.join(counted)}, of {episodes} episodes each; "
        "these count with the initial distance. "
    )


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"
