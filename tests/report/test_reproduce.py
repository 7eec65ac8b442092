"""The commands on a report's page make the same again, whatever the evaluation was told."""

import shlex
from dataclasses import replace

import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.results import Summary
from acwm_core.recipe import compose
from acwm_interventions.evaluate import evaluate_run
from acwm_report.page import write_report
from acwm_report.reproduce import commands
from acwm_severity.curves import read_severity
from acwm_severity.sweep import sweep_severity
from tests import tiny
from tests.report import synthetic

SWEEP = "factors.colour=200,90"

PUBLISHED = "evaluation.protocol=acwm-phys"


def settings(run, overrides):
    return EvaluationConfig(**compose(run / "recipe.yaml", overrides).evaluation).to_dict()


def told(line):
    """The overrides of a line `acwm evaluate`."""
    acwm, command, _, *overrides = shlex.split(line)
    assert (acwm, command) == ("acwm", "evaluate")
    return overrides


@pytest.mark.parametrize(
    ("recipe", "overrides", "line"),
    [
        ({}, [], ""),
        (
            {},
            ["evaluation.episodes=6", "evaluation.frames=20"],
            "evaluation.frames=20 evaluation.episodes=6",
        ),
        (
            {},
            [PUBLISHED, "evaluation.steps=2", "evaluation.cuts=2"],
            "evaluation.protocol=acwm-phys evaluation.mode=windows evaluation.context_frames=1 "
            "evaluation.cuts=2 evaluation.steps=2 evaluation.episodes=50",
        ),
        ({"steps": 3, "seed": 4}, ["evaluation.steps=null"], "evaluation.steps=null"),
        ({}, ["evaluation.metrics=[mse]"], """'evaluation.metrics=["mse"]'"""),
        (
            {"metric_options": {"lpips": {"network": "vgg"}}},
            ["evaluation.metric_options.lpips.backbone='a b.pt'"],
            None,
        ),
        (
            {"protocol": "acwm-phys", "cuts": 3},
            ["evaluation.protocol=full", "evaluation.cuts=null"],
            "evaluation.protocol=full evaluation.mode=null evaluation.context_frames=null "
            "evaluation.cuts=null evaluation.steps=null evaluation.episodes=null",
        ),
        ({"steps_sweep": [20, 5, 1]}, [], ""),  # their order means nothing
    ],
)
def test_the_overrides_compose_to_the_same_settings(
    evaluated, data, tmp_path, recipe, overrides, line
):
    run = tiny.make_run(tmp_path / "my run", data, **recipe)
    wanted = settings(run, overrides)
    before = Summary.read(evaluated)
    summary = replace(
        before,
        protocol=wanted["protocol"],
        provenance={**before.provenance, "evaluation": wanted},
    )
    found = commands(run, summary)
    assert settings(run, told(found[2])) == wanted
    if line is not None:
        assert found[2] == f"acwm evaluate '{run}-again' {line}".strip()
    generated = f"acwm generate drift --episodes 2,5,4 --size 32x32 --seed 0 --out {data}"
    assert found[0] == generated
    assert shlex.split(found[1]) == ["acwm", "fit", f"{run}/recipe.yaml", "--out", f"{run}-again"]
    assert shlex.split(found[3]) == ["acwm", "report", f"{run}-again"]


@pytest.mark.ci
def test_the_commands_run_and_make_the_same(tmp_path):
    """Trained on one dataset, evaluated on another, with overrides: all lines, from nothing."""
    data = tiny.make_dataset(tmp_path / "the data", ind_test=0, ood_test=0)
    other = tiny.make_dataset(tmp_path / "other", train=0, ind_test=2, ood_test=2)
    trainer = {"max_steps": 1, "accelerator": "cpu", "enable_progress_bar": False}
    parts = {"trainer": trainer, "training": {"warmup_steps": 0, "cpu_threads": 1}}
    run = tiny.make_run(tmp_path / "run", data, parts=parts, videos=0)
    overrides = ["evaluation.episodes=2", "evaluation.frames=5", "evaluation.metrics=[mse,psnr]"]
    overrides += ["evaluation.counterfactual_metrics=[]", "evaluation.perturbed_episodes=0"]
    evaluate_run(run, data=other, overrides=overrides, progress=False)
    before = Summary.read(run)
    lines = commands(run, before)
    assert len(lines) == 5
    severity = [*overrides, "evaluation.severity_episodes=2"]
    list(sweep_severity(run, [SWEEP], data=other, overrides=severity, workers=0, progress=False))
    (curve,) = read_severity(run)
    lines = commands(run, before)
    assert len(lines) == 6
    data.rename(tmp_path / "away")
    other.rename(tmp_path / "away too")
    for line in lines:
        acwm, *arguments = shlex.split(line)
        assert acwm == "acwm"
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0
    after = Summary.read(tmp_path / "run-again")
    assert (tmp_path / "run-again/report.html").is_file()
    assert after.provenance["evaluation"] == before.provenance["evaluation"]
    assert after.provenance["dataset"] == before.provenance["dataset"]  # checksums, too
    (again,) = read_severity(tmp_path / "run-again")
    assert [point.checksum for point in again.points] == [p.checksum for p in curve.points]
    assert again.provenance["evaluation"] == curve.provenance["evaluation"]
    for split, scores in before.splits.items():  # the first frame is copied by no model
        assert after.splits[split].scores.rows["copy"] == scores.scores.rows["copy"]


def test_a_dataset_behind_a_url_is_named_by_it(evaluated, data, tmp_path):
    summary = Summary.read(evaluated)
    cached = tmp_path / "cached"
    cached.mkdir()
    (cached / ".origin").write_text("hf://datasets/somebody/drift")
    summary.provenance["dataset"]["path"] = str(cached)
    assert shlex.split(commands(evaluated, summary)[2])[-2:] == [
        "--data",
        "hf://datasets/somebody/drift",
    ]
    run = tiny.make_run(tmp_path / "run", data)
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace(str(data), "hf://datasets/somebody/drift/"))
    lines = commands(run, summary)
    assert [shlex.split(line)[1] for line in lines] == ["fit", "evaluate", "report"]
    assert "--data" not in lines[1]


def test_an_imported_run_is_imported_again(evaluated, tmp_path):
    summary = Summary.read(evaluated)
    summary.provenance["imported"] = "acwm import-checkpoint 'a b.pt' env=drift"
    assert commands(evaluated, summary)[1] == (
        f"acwm import-checkpoint 'a b.pt' env=drift --out {evaluated}-again"
    )


def test_the_page_says_which_episodes_were_taken(tmp_path):
    scores, windows = np.linspace(20, 26, 4), np.linspace(20, 26, 6).reshape(3, 2)
    runs = [
        synthetic.run(
            tmp_path / "first",
            [*synthetic.clips(scores), *synthetic.clips(scores, "ood_test")],
            settings={"frames": 9},
            steps=2,
        ),
        synthetic.run(
            tmp_path / "windows",
            synthetic.clips(windows, starts=(0, 4)),
            settings={"frames": 9, "cuts": 2},
            steps=1,
        ),
        synthetic.run(tmp_path / "whole", synthetic.clips(scores)),
    ]
    text = write_report(runs, tmp_path / "page.html").read_text(encoding="utf-8")
    for said in (
        "first 9 frames of 4 of 20 ind_test, 4 of 20 ood_test episodes, 2 sampling steps",
        "2 windows of 9 frames of 3 of 20 ind_test episodes, 1 sampling step,",
        "all frames of 4 of 20 ind_test episodes, 5 sampling steps",
    ):
        assert said in text
