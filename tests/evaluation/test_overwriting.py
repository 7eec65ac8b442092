"""A result is not replaced by one of other settings without a word."""

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.results import FOLDER, SUMMARY, VIDEOS, Summary
from acwm_core.evaluation.storage import (
    EPISODES,
    read_scores,
    refuse_other_result,
    replacing_result,
    result_file,
)
from acwm_core.files import held
from acwm_core.recipe import compose
from acwm_interventions.evaluate import evaluate_run
from acwm_report.comparison import compare_runs
from acwm_report.page import write_report
from acwm_severity.sweep import sweep_severity
from tests import tiny

FAST = {"counterfactual_episodes": 0, "perturbed_episodes": 0, "videos": 0}


@pytest.fixture(scope="module")
def done(data, tmp_path_factory):
    folder = tiny.make_run(tmp_path_factory.mktemp("done") / "run", data, **FAST)
    evaluate_run(folder, progress=False)
    return folder


@pytest.fixture
def run(done, tmp_path):
    """An evaluated run of one's own."""
    return shutil.copytree(done, tmp_path / "run")


def refuse(run, *overrides, **checksums):
    """Ask whether a result may be replaced by one with these overrides, on these data."""
    recipe = compose(run / "recipe.yaml", overrides, sections=["evaluation"])
    there = Summary.read(run).provenance["dataset"]["checksums"]
    config = EvaluationConfig(**recipe.evaluation)
    refuse_other_result(run / FOLDER / SUMMARY, config, there | checksums)


def test_other_settings_are_refused_before_any_work(run):
    before = (run / FOLDER / SUMMARY).read_bytes()
    outcome = CliRunner().invoke(main, ["evaluate", str(run), "evaluation.steps=1"])
    assert outcome.exit_code == 2
    assert len(outcome.output.splitlines()) == 1
    assert "summary.json holds a result made with evaluation.steps=null" in outcome.output
    assert "--out" in outcome.output
    assert "--overwrite" in outcome.output
    assert (run / FOLDER / SUMMARY).read_bytes() == before


def test_equal_settings_and_those_that_change_nothing_may_replace_it(run):
    refuse(run)
    refuse(run, "evaluation.batch_size=3", "evaluation.device=cuda")


def test_a_curve_is_not_lost_and_one_that_was_not_made_does_not_count(run, evaluated):
    refuse(run, "evaluation.steps_sweep=[1, 2]")
    with pytest.raises(DataError, match=r"made with evaluation.steps_sweep=\[1, 2, 6\]"):
        refuse(evaluated, "evaluation.steps_sweep=[]")


def test_other_data_are_refused(run):
    with pytest.raises(DataError, match=r"made with ind_test of other data: .* --out"):
        refuse(run, ind_test="0" * 64)


def test_overwriting_is_asked_for(run):
    evaluate_run(run, overrides=["evaluation.steps=1"], overwrite=True, progress=False)
    assert Summary.read(run).provenance["evaluation"]["steps"] == 1


@pytest.mark.ci
def test_another_folder_is_reported_and_compared_like_a_run(run, tmp_path):
    other = tmp_path / "one-step"
    words = ["evaluate", str(run), "evaluation.steps=1", "--out", str(other)]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 0, outcome.output
    assert f"next: acwm report {other}" in outcome.output
    assert Summary.read(other).run == "one-step"
    assert Summary.read(run).provenance["evaluation"]["steps"] is None
    assert write_report([run, other], tmp_path / "page.html").stat().st_size
    assert compare_runs([run, other]).runs == {"run": str(run), "one-step": str(other)}
    refused = CliRunner().invoke(main, [*words[:2], "--out", str(other)])
    assert "evaluation.steps=1" in refused.output


def test_a_curve_of_other_settings_or_with_other_values_is_not_lost(run):
    """A sweep with other values of the same factor would replace the curve; one with more may."""

    def sweep(values, *words, **options):
        settings = ["evaluation.severity_episodes=2", *words]
        texts = [f"factors.colour={values}"]
        found = sweep_severity(run, texts, overrides=settings, workers=0, progress=False, **options)
        return [point.value for point in next(iter(found)).points]

    assert sweep("90,200") == [90, 200]
    with pytest.raises(DataError, match=r"colour\.json holds a result made with .*--out"):
        sweep("90,200", "evaluation.steps=1")
    with pytest.raises(DataError, match=r"holds a result made with colour=200: .*--out"):
        sweep("90,220")
    assert sweep("90,200,220") == [90, 200, 220]
    assert sweep("90,220", "evaluation.steps=1", overwrite=True) == [90, 220]


@pytest.mark.parametrize("text", ['{"provenance": {"evaluation": []}}', "{}", "\x1b"])
def test_a_result_that_cannot_be_read_is_worth_nothing(tmp_path, text):
    (tmp_path / SUMMARY).write_text(text)
    refuse_other_result(tmp_path / SUMMARY, EvaluationConfig(), {})


def test_two_evaluations_at_once_are_refused(run, monkeypatch):
    monkeypatch.setattr("acwm_core.files.ENDING_SECONDS", 0.0)
    with held(run / FOLDER), pytest.raises(DataError, match="another command is writing to"):
        evaluate_run(run, progress=False)


@pytest.mark.ci
def test_a_result_that_is_replaced_is_the_old_or_the_new_one_at_every_moment(data, tmp_path):
    """Summary, scores and videos, read by others before and after every file is renamed."""
    run = tiny.make_run(tmp_path / "run", data, **FAST | {"videos": 1})
    evaluate_run(run, progress=False)

    def result():
        folder, summary = run / FOLDER, Summary.read(run)
        videos = [result_file(folder, f"{VIDEOS}/{each.file}") for each in summary.videos]
        files = [folder / SUMMARY, result_file(folder, EPISODES), *videos]
        return tuple(file_sha256(file) for file in files)

    old, seen, replace = result(), [], Path.replace

    def watched(path, target):
        seen.append(result())
        moved = replace(path, target)
        seen.append(result())
        return moved

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Path, "replace", watched)
        evaluate_run(run, overrides=["evaluation.steps=1"], overwrite=True, progress=False)
    new = result()
    assert len({*old} & {*new}) == 0
    assert set(seen) == {old, new}
    assert [path.name for path in (run / FOLDER).glob(".result-*")] == []


def test_what_a_killed_evaluation_left_is_used_and_then_put_in_place(run):
    folder = run / FOLDER
    rows = read_scores(run)
    waiting = folder / f".result-{file_sha256(folder / SUMMARY)}"
    waiting.mkdir()
    (folder / EPISODES).replace(waiting / EPISODES)
    (folder / ".result-new").mkdir()
    assert read_scores(run) == rows
    with pytest.raises(ZeroDivisionError), replacing_result(folder):
        raise ZeroDivisionError
    assert read_scores(run) == rows
    assert (folder / EPISODES).is_file()
    assert [*folder.glob(".result-*")] == []
