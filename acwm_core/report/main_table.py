"""The main table, in the layout of the paper: environments down, splits and metrics across."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from acwm_core.evaluation.published import Published
from acwm_core.evaluation.results import Estimate, MetricInfo, Summary
from acwm_core.report.table import WORSE, Cell, Column, Row, Table
from acwm_core.report.tables import clips_title
from acwm_core.report.wording import MISSING, Scale, metric_title, split_title

METRICS = ("mse", "m_mse", "ssim", "psnr")
"""The paper's metrics, in its order."""

SCALES = {
    "mse": Scale(1000.0, 3, "×10⁻³"),
    "m_mse": Scale(1000.0, 2, "×10⁻³"),
    "ssim": Scale(1.0, 3, ""),
    "psnr": Scale(1.0, 2, "dB"),
}
"""As the paper writes them."""

SPLITS = ("ind_test", "ood_test")

CAPTION = (
    "MSE and M-MSE in thousandths; PSNR of the pooled error. ▼: worse out of distribution than in "
    "distribution. In grey, the published figures of the same or the nearest setting: they were "
    "measured on the paper's own simulations at 240×240, so they say how hard a task is, not who "
    "is better."
)


def main_table(summaries: Sequence[Summary]) -> Table | None:
    """One line per run, the published figures below it; None without any of the paper's metrics.

    Args:
        summaries: of the runs.
    """
    names = [m for m in METRICS if any(m in each.metrics for each in summaries)]
    splits = [s for s in SPLITS if any(s in each.splits for each in summaries)]
    if not names or not splits:
        return None
    columns = [
        Column(
            metric_title(name),
            "",
            "↑" if name in ("ssim", "psnr") else "↓",
            group=split_title(split),
            key=f"{split}_{name}",
        )
        for split in splits
        for name in names
    ]
    rows: list[Row] = []
    environments = [summary.parts["env"] for summary in summaries]
    for number, summary in enumerate(summaries):
        title, note = summary.parts["env"].replace("_", " ").title(), summary.run
        if environments.count(summary.parts["env"]) > 1:
            title, note = note, title
        link = f"run{number + 1}" * (len(summaries) > 1)
        rows.append(_score_row(summary, (title, note), link, splits, names))
        following = summaries[number + 1].published if number + 1 < len(summaries) else None
        if summary.published and summary.published != following:
            rows.append(_published_row(summary, summary.published, splits, names))
    published = any(summary.published for summary in summaries)
    caption = CAPTION if published else CAPTION.partition(" In grey")[0]
    return Table("", columns, rows, "Environment", caption, name="main")


def _score_row(
    summary: Summary,
    title: tuple[str, str],
    link: str,
    splits: Sequence[str],
    names: Sequence[str],
) -> Row:
    scores = {split: each.scores.rows["model"] for split, each in summary.splits.items()}
    cells = [score_cell(scores, split, name, summary.metrics) for split in splits for name in names]
    counts = {clips_title(each.scores) for each in summary.splits.values()}
    note = ", ".join([title[1], summary.protocol, *sorted(counts)])
    return Row(title[0], note, "", cells, strong=True, link=link)


def _published_row(
    summary: Summary, published: Published, splits: Sequence[str], names: Sequence[str]
) -> Row:
    row = published.row
    figures = {
        split: {name: Estimate(value) for name, value in row.scores.get(split, {}).items()}
        for split in splits
    }
    cells = [
        score_cell(figures, split, name, summary.metrics) for split in splits for name in names
    ]
    where = " ".join(filter(None, (row.column, row.row)))
    other = ", other parts" * (not published.same_parts)
    return Row("published", f"{row.citation}, {row.label}: {where}{other}", "", cells, quiet=True)


def score_cell(
    scores: Mapping[str, Mapping[str, Estimate]],
    split: str,
    name: str,
    metrics: Mapping[str, MetricInfo],
) -> Cell:
    """A score, marked if it is worse out of distribution than in distribution.

    Args:
        scores: by split and metric.
        split: which of them,
        name: and which metric.
        metrics: tell which way is good.
    """
    estimate = scores.get(split, {}).get(name)
    if estimate is None or name not in metrics:
        return Cell(MISSING)
    inside = scores.get("ind_test", {}).get(name)
    mark = ""
    if split == "ood_test" and inside and None not in (estimate.value, inside.value):
        change = (estimate.value or 0.0) - (inside.value or 0.0)
        worse = change < 0 if metrics[name].higher_is_better else change > 0
        mark = WORSE if worse else ""
    scale = SCALES.get(name) or Scale.of([estimate.value], metrics[name].unit)
    return Cell.of(estimate, scale, mark=mark)
