"""Rankings of policies on a page, and in files."""

import shutil
from dataclasses import replace

import pytest

from acwm_core.evaluation.results import Summary, write_json
from acwm_core.evaluation.statistics import Estimate
from acwm_planning.policies.ranking import RANKING_FILE, Agreement, Decisions, PolicyScores, Ranking
from acwm_report.page import export_report, write_report
from acwm_report.rankings import ranking_tables
from acwm_report.run import EvaluatedRun


def ranking(weights):
    sure, none = Estimate(0.75, 0.5, 0.9), Estimate(None)
    agreement = Agreement(sure, sure, none, Estimate(0.1, 0.0, 0.2), Estimate(-0.25, -0.5, 0.0))
    scores = {"truth": 0.5, "estimator": 0.4, "model": 0.3}
    returns = {"truth": -2.0, "estimator": -2.5, "model": -3.0}
    return Ranking(
        environment="drift",
        task="<place>",
        unit="px",
        weights=weights,
        episodes=6,
        policies=[PolicyScores(name, "open", scores, returns) for name in ("good", "poor")],
        agreement={
            judge: {"success": agreement, "returns": agreement} for judge in ("estimator", "model")
        },
        decisions={"model": Decisions(6, Estimate(0.2), Estimate(0.4), Estimate(0.2))},
    )


@pytest.fixture
def mine(evaluated, tmp_path):
    run = shutil.copytree(evaluated, tmp_path / "run")
    (run / "ranking" / "place").mkdir(parents=True)
    return run


@pytest.mark.ci
def test_a_ranking_stands_on_the_page_and_in_files(mine, tmp_path):
    weights = Summary.read(mine).provenance["weights_sha256"]
    write_json(mine / "ranking" / "place" / RANKING_FILE, ranking(weights))
    text = write_report([mine]).read_text()
    assert "<h2>Ranking policies</h2>" in text
    assert "&lt;place&gt; · 2 policies, 6 episodes of each" in text
    assert "Regret: 0.2 px per action by the model’s choice, 0.4 at random, over 6 starts" in text
    assert "<place>" not in text
    names = {path.name for path in export_report([mine], tmp_path / "out")}
    (csv,) = [n for n in names if n.startswith("policies-") and n.endswith(".csv")]
    (line, *_) = (tmp_path / "out" / "tables" / csv).read_text().splitlines()[1:]
    assert "0.75,0.5,0.9" in line
    assert "-0.25" in line
    assert any(name.startswith("policies-") and name.endswith(".pdf") for name in names)


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ({}, {}, None),
        ({"model": 2}, {}, "in 2 of predictions, of 12 episodes"),
        ({"estimator": 1, "model": 2}, {"model": 3}, "in 5 of predictions and 1 of true pictures,"),
    ],
)
def test_episodes_that_no_picture_tells_are_counted(mine, first, second, told):
    weights = Summary.read(mine).provenance["weights_sha256"]
    found = ranking(weights)
    policies = [replace(p, unread=n) for p, n in zip(found.policies, (first, second), strict=True)]
    write_json(mine / "ranking" / "place" / RANKING_FILE, replace(found, policies=policies))
    (table,) = ranking_tables(EvaluatedRun.read(mine, "run1"))
    assert ("The estimator found no distance" in table.caption) == (told is not None)
    assert told is None or f"The estimator found no distance {told}" in table.caption


@pytest.mark.ci
def test_one_of_other_weights_or_none_is_not(mine):
    run = EvaluatedRun.read(mine, "run1")
    assert ranking_tables(run) == []
    write_json(mine / "ranking" / "place" / RANKING_FILE, ranking("0" * 64))
    assert ranking_tables(run) == []
    assert "ranks policies" not in write_report([mine]).read_text()
