"""Curves of sweeps on the page: those of the weights that the rest of it is of, and no others."""

import html
import json
import re
import shlex
import shutil

import pytest

from acwm_core.evaluation.results import Summary
from acwm_report.charts import outdated_curves, severity_charts
from acwm_report.page import write_report
from acwm_report.run import EvaluatedRun
from acwm_severity.sweep import sweep_severity

CURVE = "run1-severity-colour"
VALUES = "factors.colour=200,90"


@pytest.fixture(scope="module")
def swept(evaluated, tmp_path_factory):
    run = shutil.copytree(evaluated, tmp_path_factory.mktemp("swept") / "run")
    words = ["evaluation.severity_episodes=2"]
    list(sweep_severity(run, [VALUES], overrides=words, workers=0, progress=False))
    return run


def page_of(run):
    return html.unescape(write_report([run]).read_text(encoding="utf-8"))


def of_other_weights(run, evaluated):
    """Let the curve be of other weights, and evaluated then."""
    file = run / "evaluation" / "severity" / "colour.json"
    curve = json.loads(file.read_text())
    curve["provenance"] |= {"weights_sha256": "0" * 64, "evaluated": evaluated}
    file.write_text(json.dumps(curve))
    return EvaluatedRun.read(run, "run1")


def test_a_curve_of_the_same_weights_is_shown(swept):
    read = EvaluatedRun.read(swept, "run1")
    assert [chart.name for chart in severity_charts(read)] == [CURVE]
    assert outdated_curves(read) == []


def test_a_curve_of_earlier_weights_asks_to_be_made_anew(swept, tmp_path):
    run = shutil.copytree(swept, tmp_path / "run")
    read = of_other_weights(run, Summary.read(run).provenance["evaluated"])
    assert severity_charts(read) == []
    assert [older for _, older in outdated_curves(read)] == [True]
    page = page_of(run)
    assert CURVE not in page
    assert "The curve of colour is left out, because it belongs to earlier weights" in page
    (command,) = re.findall(r"<code>(acwm evaluate .* --sweep .*)</code>", page)
    assert shlex.split(command) == ["acwm", "evaluate", str(run), "--sweep", VALUES]


def test_a_curve_of_later_weights_asks_for_the_rest_anew(swept, tmp_path):
    run = shutil.copytree(swept, tmp_path / "run")
    read = of_other_weights(run, "2999-01-01T00:00:00+00:00")
    assert [older for _, older in outdated_curves(read)] == [False]
    page = page_of(run)
    assert "The curve of colour is left out, because it belongs to later weights" in page
    assert f"Update the rest with <code>acwm evaluate {run}</code>" in page
