"""Curves over the horizon: which rows and metrics, in which units, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from acwm_core.evaluation.results import MetricInfo
from acwm_report.charts import horizon_charts, state_horizon_charts
from acwm_report.run import EvaluatedRun
from tests.report import synthetic

POSITION = {
    "model": [0.0, 0.01, 0.03],
    "truth": [0.0, 0.001, None],
    "shuffled": [None, None, None],
}


@pytest.fixture
def run(tmp_path):
    folder = synthetic.run(tmp_path / "run", synthetic.clips(np.linspace(20, 30, 4)))
    read = EvaluatedRun.read(folder, "run1")
    summary = read.summary
    info = {
        **summary.metrics,
        "position_error": MetricInfo("m", higher_is_better=False, title="Position error"),
    }
    (split,) = summary.splits.values()
    horizon = {
        kind: {**row, "position_error": POSITION.get(kind, [0.0, 0.2, 0.2])}
        for kind, row in {**split.horizon, "truth": {}}.items()
    }
    rows = {kind: {**row, "position_error": row["psnr"]} for kind, row in split.scores.rows.items()}
    scores = replace(split.scores, rows=rows)
    shown = {"ind_test": replace(split, scores=scores, horizon=horizon)}
    return replace(read, summary=replace(summary, metrics=info, splits=shown))


def test_positions_over_the_horizon_are_in_millimetres_beside_their_floor(run):
    (chart,) = state_horizon_charts(run)
    assert chart.name == "run1-horizon-position-error-ind_test"
    assert chart.title == "Position error, in distribution"
    assert "Model, true actions 30" in chart.description
    assert "mm" in chart.svg
    dashed = {title for title, _, dashed in chart.legend if dashed}
    assert dashed == {"True video", "Codec reconstruction"}


def test_rows_in_which_a_metric_is_not_defined_have_no_curve(run):
    titles = [title for title, _, _ in state_horizon_charts(run)[0].legend]
    assert "Model, other actions" not in titles
    (headline,) = horizon_charts(run, "psnr")
    titles = [title for title, _, _ in headline.legend]
    assert "Model, other actions" in titles
    assert "True video" not in titles


def test_without_metrics_of_states_there_is_no_such_chart(tmp_path):
    folder = synthetic.run(tmp_path / "run", synthetic.clips(np.linspace(20, 30, 4)))
    assert state_horizon_charts(EvaluatedRun.read(folder, "run1")) == []
