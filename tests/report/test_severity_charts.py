"""Curves of sweeps on the page: those of the weights that the rest of it is of, and no others."""

import html
import json
import re
import shlex

import pytest

from acwm_core.evaluation.evaluate import evaluate_run
from acwm_report.page import export_report, write_report
from acwm_severity.sweep import sweep_severity
from tests import tiny

CURVE = "run1-severity-colour"
VALUES = "factors.colour=200,90"


def sweep(run, text=VALUES):
    list(sweep_severity(run, [text], workers=0, progress=False))


def page_of(run):
    return html.unescape(write_report([run]).read_text(encoding="utf-8"))


@pytest.fixture
def run(data, tmp_path):
    settings = {"severity_episodes": 2, "counterfactual_episodes": 0, "perturbed_episodes": 0}
    run = tiny.make_run(tmp_path / "run", data, **settings)
    evaluate_run(run, progress=False)
    sweep(run)
    assert CURVE in page_of(run)
    other = tiny.make_run(tmp_path / "other", data, seed=1)
    (other / "model.safetensors").replace(run / "model.safetensors")  # it was trained on
    return run


def test_a_curve_of_earlier_weights_is_left_out_until_it_is_made_anew(run, tmp_path):
    evaluate_run(run, progress=False)
    page = page_of(run)
    assert CURVE not in page
    assert "The curve of colour is left out, because it is of earlier weights" in page
    assert [each.name for each in export_report([run], tmp_path) if "severity" in each.name] == []
    (command,) = re.findall(r"<code>(acwm evaluate .* --sweep .*)</code>", page)
    assert shlex.split(command) == ["acwm", "evaluate", str(run), "--sweep", VALUES]
    sweep(run)
    page = page_of(run)
    assert CURVE in page
    assert "left out" not in page


def test_a_curve_of_later_weights_asks_for_the_rest_anew(run):
    sweep(run, "factors.ground=30,60")
    made = run / "evaluation" / "severity" / "ground.json"
    curve = json.loads(made.read_text())
    curve["provenance"]["evaluated"] = "2999-01-01T00:00:00+00:00"  # times have whole seconds
    made.write_text(json.dumps(curve))
    page = page_of(run)
    assert CURVE in page
    assert "run1-severity-ground" not in page
    assert "The curve of ground is left out, because it is of later weights" in page
    assert f"make the rest anew with <code>acwm evaluate {run}</code>" in page
