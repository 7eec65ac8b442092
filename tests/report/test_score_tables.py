"""The main table: our figures and the paper's, in the paper's layout."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from acwm_core.evaluation.metric import MetricInfo
from acwm_core.evaluation.protocol import published_for
from acwm_core.evaluation.statistics import Estimate
from acwm_core.plugins import Catalog
from acwm_report import run as runs
from acwm_report.page import write_report
from acwm_report.run import EvaluatedRun, described
from acwm_report.scores import ScoreGrid, main_table
from acwm_report.tables import score_tables, state_tables
from acwm_report.terminal import print_summary
from tests.report import synthetic

SCORES = np.linspace(20, 26, 6)


def run(path, name, environment, key="run1", shift=-2.0):
    rows = [*synthetic.clips(SCORES), *synthetic.clips(SCORES + shift, "ood_test")]
    read = EvaluatedRun.read(synthetic.run(path / name, rows, environment=environment), key)
    published = published_for({"env": environment})
    return replace(read, summary=replace(read.summary, published=published))


def test_the_papers_figures_stand_below_ours_and_drops_are_marked(tmp_path):
    ours = run(tmp_path, "mine", "robot_arm", shift=1.0)
    table = main_table([ours])
    assert table.groups == [("In distribution", 2), ("Out of distribution", 2)]
    mine, paper = table.rows
    assert (mine.title, paper.title) == ("Robot Arm", "published")
    assert mine.note == "mine, full, 6 episodes"
    assert paper.note == "arXiv 2605.08567, tab:eval_main: Robot Arm, other components"
    expected = ours.summary.splits["ood_test"].scores.rows["model"]["mse"]
    assert (mine.cells[2].value, mine.cells[2].low) == (expected.value, expected.low)
    assert mine.cells[2].text == f"{expected.value * 1000:.3f}"
    assert [cell.worse for cell in mine.cells] == [False] * 4  # it is better out of it
    # Table 2 of the paper: MSE 1.434 and 6.559 thousandths, PSNR 28.43 and 21.83 dB.
    assert [cell.text for cell in paper.cells] == ["1.434", "28.43", "6.559", "21.83"]
    assert [cell.worse for cell in paper.cells] == [False, False, True, True]


def test_runs_of_one_environment_are_told_apart_and_share_the_published_row(tmp_path):
    arms = [
        run(tmp_path, name, "robot_arm", f"run{number}")
        for number, name in enumerate(("plain", "attentive"), start=1)
    ]
    table = main_table([*arms, run(tmp_path, "alone", "reacher", "run3")])
    titles = [row.title for row in table.rows]
    assert titles == ["plain", "attentive", "published", "Reacher", "published"]
    assert [row.link for row in table.rows] == ["run1", "run2", "", "run3", ""]


@pytest.mark.parametrize(("reach", "worse"), [(None, True), (0.6, True), (0.8, False)])
def test_a_drop_is_marked_if_the_intervals_do_not_explain_it(reach, worse):
    """Two intervals of half-width r explain a difference up to r √2."""
    ends = [(None, None) if reach is None else (v - reach, v + reach) for v in (31.0, 30.0)]
    scores = {
        (split, "psnr"): Estimate(value, *both)
        for split, value, both in zip(("ind_test", "ood_test"), (31.0, 30.0), ends, strict=True)
    }
    grid = ScoreGrid.of([scores], {"psnr": MetricInfo("dB", True, "pixels")})
    assert [cell.worse for cell in grid.cells(scores)] == [False, worse]


def test_there_is_none_without_metrics_of_pixels(tmp_path):
    read = run(tmp_path, "run", "drift")
    assert read.summary.published is None
    assert main_table([replace(read, summary=replace(read.summary, metrics={}))]) is None


class Acuity(synthetic.Quality):
    """A metric of pixels that core has never heard of."""

    name = "acuity"
    title = "Acuity"
    unit = "lp/px"


def test_a_foreign_metric_of_pixels_stands_among_those_of_pixels(tmp_path, monkeypatch):
    """By what it says of itself; of a result that says nothing, by what is registered."""
    metrics = Catalog().registry("metric")
    metrics.registering("foreign", None)
    metrics.add("acuity", f"{__name__}:Acuity")
    installed = SimpleNamespace(component=lambda kind, name: metrics[name])
    monkeypatch.setattr(runs, "catalog", lambda: installed)
    folder = synthetic.run(tmp_path / "run", synthetic.clips(SCORES))
    read = EvaluatedRun.read(folder, "run1")
    rows = read.summary.splits["ind_test"].scores.rows
    for row in rows.values():
        row["acuity"] = row["odd"] = row["psnr"]
    for info in (Acuity().info, MetricInfo("lp/px", higher_is_better=True)):
        told = described({**read.summary.metrics, "acuity": info, "odd": MetricInfo("", False)})
        found = replace(read, summary=replace(read.summary, metrics=told))
        (scores,), (states,) = score_tables(found), state_tables(found)
        heads = [(each.title, each.unit, each.better) for each in scores.columns]
        assert ("Acuity", "lp/px", "↑") in heads
        assert [column.key for column in main_table([found]).columns][-1] == "ind_test_acuity"
        assert [row.title for row in states.rows] == ["ODD"]


@pytest.mark.parametrize(("count", "few"), [(4, True), (6, False)])
def test_a_split_without_intervals_says_why(tmp_path, capsys, count, few):
    folder = synthetic.run(tmp_path / "it", synthetic.clips(SCORES[:count]), environment="reacher")
    read = EvaluatedRun.read(folder, "run1")
    print_summary(read.summary)
    said = capsys.readouterr().out
    why = "which takes 5 of them: ind_test has 4"
    assert ("±–" in said) == (why in said) == few
    page = write_report([folder], tmp_path / "page.html").read_text()
    assert (why in page) == few
