"""The main table: our figures and the paper's, in the paper's layout."""

from dataclasses import replace

import numpy as np

from acwm_core.evaluation.published import published_for
from acwm_core.evaluation.results import Summary
from acwm_core.report.main_table import main_table
from tests.report import synthetic

SCORES = np.linspace(20, 26, 6)


def summary(path, name, environment, shift=-2.0):
    rows = [*synthetic.clips(SCORES), *synthetic.clips(SCORES + shift, "ood_test")]
    read = Summary.read(synthetic.run(path / name, rows, environment=environment))
    return replace(read, published=published_for({"env": environment}))


def test_the_papers_figures_stand_below_ours_and_drops_are_marked(tmp_path):
    ours = summary(tmp_path, "mine", "robot_arm", shift=1.0)
    table = main_table([ours])
    assert table.groups == [("In distribution", 2), ("Out of distribution", 2)]
    mine, paper = table.rows
    assert (mine.title, paper.title) == ("Robot Arm", "published")
    assert mine.note == "mine, full, 6 episodes"
    assert paper.note == "arXiv 2605.08567, tab:eval_main: Robot Arm, other parts"
    expected = ours.splits["ood_test"].scores.rows["model"]["mse"]
    assert (mine.cells[2].value, mine.cells[2].low) == (expected.value, expected.low)
    assert mine.cells[2].text == f"{expected.value * 1000:.3f}"
    assert [cell.mark for cell in mine.cells] == ["", "", "", ""]  # it is better out of it
    # Table 2 of the paper: MSE 1.434 and 6.559 thousandths, PSNR 28.43 and 21.83 dB.
    assert [cell.text for cell in paper.cells] == ["1.434", "28.43", "6.559", "21.83"]
    assert [cell.mark for cell in paper.cells] == ["", "", "worse", "worse"]


def test_runs_of_one_environment_are_told_apart_and_share_the_published_row(tmp_path):
    arms = [summary(tmp_path, name, "robot_arm") for name in ("plain", "attentive")]
    table = main_table([*arms, summary(tmp_path, "alone", "reacher")])
    titles = [row.title for row in table.rows]
    assert titles == ["plain", "attentive", "published", "Reacher", "published"]
    assert [row.link for row in table.rows] == ["run1", "run2", "", "run3", ""]
    assert [cell.mark for cell in table.rows[0].cells] == ["", "", "worse", "worse"]


def test_there_is_none_without_the_papers_metrics(tmp_path):
    read = summary(tmp_path, "run", "drift")
    assert read.published is None
    assert main_table([replace(read, metrics={})]) is None
