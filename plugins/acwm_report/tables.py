"""The tables of one run, and the table of differences between several runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from acwm_core.errors import DataError
from acwm_core.evaluation.metric import MetricInfo
from acwm_core.evaluation.results import (
    Estimate,
    Score,
    SetSummary,
    SplitSummary,
    VideoRecord,
    defined,
)
from acwm_core.evaluation.shares import error_shares
from acwm_core.evaluation.views import metric_and_view, of_view
from acwm_report.charts import counterfactuals
from acwm_report.comparison import compare_runs
from acwm_report.draws import draws_phrase
from acwm_report.run import EvaluatedRun, described
from acwm_report.table import MISSING, PERCENT, PLAIN, Cell, Column, Row, Scale, Table
from acwm_report.titles import (
    COLUMNS,
    ENSEMBLE_ROWS,
    OVER,
    ROWS,
    branch_title,
    clips_title,
    counted,
    label_title,
    short_title,
    split_title,
)
from acwm_report.videos import EmbeddedVideo


def score_tables(run: EvaluatedRun) -> list[Table]:
    """One table per split: the scores of every evaluation row in the pixel metrics.

    The caption says how much of the squared error is the codec's, the world's and the model's. Out
    of distribution, a further row shows the change. Where a frame shows several views, the same
    rows follow for each. If there are no pixel metrics, all metrics are shown.
    """
    metrics = run.summary.metrics
    places = list(map(metric_and_view, run.metrics("pixels") or metrics))
    scales = {name: run.scale(name) for name in dict.fromkeys(name for name, _ in places)}
    columns = [Column.of(metrics[name], scale, name) for name, scale in scales.items()]
    tables: list[Table] = []
    for split, result in run.summary.splits.items():
        views = dict.fromkeys(view for _, view in places)
        rows = [row for view in views for row in _score_rows(run, split, scales, view)]
        title, parts = _title(split, result), error_shares(result.scores)
        about = f"Approximate {parts}." if parts else ""
        drawn = draws_phrase(run.summary, split)
        about = " ".join(filter(None, (about, f"{drawn[:1].upper()}{drawn[1:]}." if drawn else "")))
        tables.append(Table(title, columns, rows, "Prediction", about, f"scores-{split}"))
    return tables


def _score_rows(
    run: EvaluatedRun, split: str, scales: Mapping[str, Scale], view: str
) -> Iterator[Row]:
    """The scores of a split in one view; ``""`` is the whole frame."""
    result = run.summary.splits[split].scores
    names = {of_view(name, view): scale for name, scale in scales.items()}
    for kind, row in ROWS.items():
        scores = result.rows.get(kind, {})
        cells = [Cell.of(scores.get(name), scale) for name, scale in names.items()]
        if any(cell.value is not None for cell in cells):
            note = result.failures(kind) or row.about
            yield Row(row.title, cells, note, kind, strong=kind == "model", group=view)
    if split == "ood_test" and run.summary.gap:
        change = run.summary.gap["model"]
        cells = [Cell.of(change.get(name), scale, signed=True) for name, scale in names.items()]
        yield Row("Change out of distribution", cells, "of the model", group=view)


def state_tables(run: EvaluatedRun) -> list[Table]:
    """One table per split with a line per state metric, and the noise floors beside the scores.

    Beside the model's score is the share of bodies and frames in which it shows what is measured.

    The columns are the rows of the evaluation. Metrics that are defined nowhere are left out, and
    so are evaluation rows in which no metric is defined.
    """
    tables: list[Table] = []
    for split, result in run.summary.splits.items():
        rows: list[Row] = []
        scores, shares = result.scores.rows, result.scores.shares.get("model", {})
        kinds = [kind for kind in COLUMNS if _defined(scores.get(kind, {}), run.metrics("states"))]
        for name in run.metrics("states"):
            info, scale = run.summary.metrics[name], run.scale(name)
            way = "higher is better" if info.higher_is_better else "lower is better"
            way = way if info.right is None else f"{info.right:g} is right"
            if any(_defined(scores[kind], [name]) for kind in kinds):
                cells = [Cell.of(scores[kind].get(name), scale) for kind in kinds]
                if shares:
                    cells.insert(1, Cell.of(Estimate(shares.get(name)), PERCENT))
                undefined = result.scores.undefined.get(name, 0)
                left_out = f"not defined on {counted(undefined, 'clip')}" if undefined else ""
                rows.append(
                    Row(info.title, cells, ", ".join(filter(None, (scale.unit, way, left_out))))
                )
        if rows and run.metrics("pixels"):
            columns = [Column(ROWS[kind].short.capitalize(), key=kind) for kind in kinds]
            if shares:
                columns.insert(1, Column("Scored", PERCENT.unit, key="scored"))
            title = _title(split, result)
            tables.append(Table(title, columns, rows, "Metric", name=f"measures-{split}"))
    return tables


def _defined(row: Mapping[str, Estimate], metrics: Sequence[str]) -> bool:
    return any(row[name].value is not None for name in metrics if name in row)


def _title(split: str, result: SplitSummary) -> str:
    return f"{split_title(split)} · {clips_title(result.scores)}"


def response_tables(run: EvaluatedRun) -> list[Table]:
    """One table per split: the response to each kind of other actions, a column per prediction."""
    tables: list[Table] = []
    for split, found in counterfactuals(run.summary).items():
        kinds = [kind for kind in COLUMNS if kind in found.rows]
        named = {name: MetricInfo("", higher_is_better=True) for name in found.rows[kinds[0]]}
        rows: list[Row] = []
        for metric, info in described(named).items():
            for branch, by_row in {"all": found.rows, **found.kinds}.items():
                cells = [Cell.of(by_row.get(kind, {}).get(metric), PLAIN) for kind in kinds]
                both = (each.get(branch, {}).get("model") for each in (found.gain, found.residual))
                gain, rest = map(PLAIN.number, both)
                note = f"model: gain {gain}, residual {rest}" if MISSING not in (gain, rest) else ""
                title = info.title if branch == "all" else branch_title(branch)
                rows.append(Row(title, cells, note, strong=branch == "all"))
        columns = [Column(ROWS[kind].short.capitalize(), key=kind) for kind in kinds]
        branches = f"{counted(found.branches, 'branch')} of {counted(found.clips, 'clip')}"
        title = f"{split_title(split)} · {branches}"
        tables.append(Table(title, columns, rows, "Other actions", name=f"response-{split}"))
    return tables


def ensemble_tables(run: EvaluatedRun) -> list[Table]:
    """One table per split: distances of futures to the simulator's, and to each other."""
    tables: list[Table] = []
    for split, found in run.summary.ensembles.items():
        values = [each.value for each in found.distance.values()]
        scale = Scale.of(values, MetricInfo("", higher_is_better=False, factor=1000.0))
        columns = [
            Column("Energy distance", scale.unit, "↓", key="energy_distance"),
            Column("Spread of futures", scale.unit, key="spread"),
        ]
        rows = [
            Row(
                title, [Cell.of(of.get(kind), scale) for of in (found.distance, found.spread)], note
            )
            for kind, (title, note) in ENSEMBLE_ROWS.items()
            if kind in found.distance
        ]
        clips = f"{counted(found.clips, 'clip')}, {counted(found.starts, 'start')}"
        title = f"{split_title(split)} · {clips}"
        about = (
            f"Starts differ by {1000 * found.moved:.2g} mm (standard deviation; joints in mrad), "
            f"the resolution of a pixel. The model has {found.draws} draws of each clip."
        )
        tables.append(Table(title, columns, rows, "Futures", about, f"ensemble-{split}"))
    return tables


def label_tables(run: EvaluatedRun) -> list[Table]:
    """The headline metric grouped by what was shifted; no table if nothing was shifted."""
    groups: list[tuple[str, SetSummary, bool]] = []
    for split, result in run.summary.splits.items():
        groups.append((split_title(split), result.scores, True))
        groups += [(f"shifted: {label_title(x)}", s, False) for x, s in result.labels.items()]
    if all(strong for _, _, strong in groups):
        return []
    name, scale = run.summary.headline, run.headline_scale()
    first = groups[0][1]
    columns = [Column("Number"), Column(run.headline.title, scale.unit)]
    baselines = [short_title(row) for row in OVER if row in first.paired]
    columns += [Column(f"above {title}", scale.unit) for title in baselines]
    columns += [Column("true actions better")] * ("shuffled" in first.paired)
    columns += [Column("Codec bound", scale.unit)] * ("codec" in first.rows)
    rows: list[Row] = []
    for title, scores, strong in groups:
        cells = [Cell(str(scores.clips)), Cell.of(scores.rows["model"][name], scale)]
        cells += [Cell.of(gain, scale, signed=True) for gain in run.gains(scores).values()]
        if "shuffled" in scores.paired:
            pair = scores.paired["shuffled"][name]
            cells.append(Cell(f"{pair.better}/{pair.clips}"))
        if "codec" in scores.rows:
            cells.append(Cell(scale.number(scores.rows["codec"][name].value)))
        rows.append(Row(title, cells, strong=strong))
    return [Table("", columns, rows, "Episodes", name="shifts")]


def episode_table(run: EvaluatedRun, videos: Sequence[EmbeddedVideo] = ()) -> Table:
    """The model's scores on every clip, the worst first, with links to the embedded videos.

    Args:
        videos: the videos that the page embeds.
    """
    summary, headline = run.summary, run.summary.headline
    scales = {name: run.scale(name) for name in summary.metrics}
    columns = [Column("Split", key="split"), Column("Shifted", key="shifted")]
    windows = any(result.start for result in run.results)
    columns += [Column("From frame", key="start")] * windows + [Column("Video", key="video")]
    key = f"{headline}_over_other_actions"
    others = {_clip(r): r.values[headline] for r in run.results if r.kind == "shuffled"}
    above = Column(f"above {short_title('shuffled')}", scales[headline].unit, key=key)
    columns += [above] * bool(others)
    columns += [Column.of(info, scales[name], name) for name, info in summary.metrics.items()]
    links = {_clip(each.record): each.key for each in videos if each.record.kind == "model"}
    splits = list(summary.splits)
    sign = 1 if run.headline.higher_is_better else -1

    def place(result: Score) -> tuple[int, float]:
        value = result.values[headline]
        return splits.index(result.split), float("inf") if math.isnan(value) else sign * value

    rows: list[Row] = []
    for result in sorted((r for r in run.results if r.kind == "model"), key=place):
        link = links.get(_clip(result), "")
        cells = [Cell(split_title(result.split)), Cell(label_title(result.ood_label) or MISSING)]
        cells += [Cell(str(result.start), value=result.start)] * windows
        cells.append(Cell("▶ play" * bool(link), link=link))
        if others:
            own, other = result.values[headline], others.get(_clip(result), float("nan"))
            gain = sign * (own - other) if own != other else 0.0
            cells.append(Cell.of(Estimate(defined(gain)), scales[headline], signed=True))
        for name, scale in scales.items():
            cells.append(Cell.of(Estimate(defined(result.values[name])), scale))
        rows.append(Row(str(result.episode), cells))
    return Table("", columns, rows, "Episode", name="episodes")


def _clip(result: Score | VideoRecord) -> tuple[str, int, int]:
    return result.split, result.episode, result.start


def difference_table(runs: Sequence[EvaluatedRun]) -> Table | str:
    """A line per pair of runs and split in the headline metric, or the reason why there is none."""
    info = runs[0].headline
    try:
        found = compare_runs([run.folder for run in runs], metrics=[runs[0].summary.headline])
    except DataError as refused:
        return str(refused)
    columns = [
        Column("Split", key="split"),
        Column("Difference", "second − first", key="difference"),
        Column("Second better", key="second_better"),
        Column("p", "Holm", key="p_corrected"),
        Column("Significant?", key="winner"),
    ]
    rows: list[Row] = []
    for each in found.differences:
        scale = Scale.of([each.first_mean, each.second_mean], info)
        p = MISSING if each.p_corrected is None else f"{each.p_corrected:.2g}"
        verdict = f"{each.winner} is better" if each.winner else "no"
        few = f"too few: {counted(each.episodes, 'episode')}"
        cells = [
            Cell(split_title(each.split)),
            Cell.of(Estimate(defined(each.difference), each.low, each.high), scale, signed=True),
            Cell(f"{each.second_better}/{each.episodes}"),
            Cell(p, value=each.p_corrected),
            Cell(verdict if each.p is not None or math.isinf(each.difference) else few),
        ]
        note = f"{info.title} {scale.unit}".strip()
        rows.append(Row(f"{each.first} → {each.second}", cells, note, strong=bool(each.winner)))
    warnings = " ".join(f"{each[:1].upper()}{each[1:]}." for each in found.warnings)
    tests = counted(found.tests, "comparison")
    corrected = (
        f"Paired bootstrap over episodes; p-values corrected for {tests} (Holm), "
        "which keeps the rate of false alarms per table at 5 %. "
    )
    caption = (
        "Mean difference per episode on the clips that both predicted, with its 95 % interval. "
        f"{corrected if found.tests else ''}{warnings}"
    )
    return Table("", columns, rows, "Runs", caption.strip(), "comparison")
