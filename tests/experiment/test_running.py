"""Whole experiments on tiny parts: killed anywhere, stopped, failing, side by side."""

import hashlib
import re
import shutil
import signal

import pytest

from acwm_experiment.steps import saved_steps
from acwm_experiment.table import Experiment
from tests.experiment.parts import EXPERIMENT, HEARD, HOLD, write_experiment
from tests.folders import wait_until

pytestmark = pytest.mark.ci

STEPS = 6  # one dataset, two trainings and evaluations, a report
RUNS = ("tiny-0", "tiny-width6-0")


def results(folder):
    """What an experiment found: weights, curves and scores of every run."""
    files = ("model.safetensors", "metrics.csv", "evaluation/episodes.parquet")
    runs = folder / "experiments" / "widths" / "runs"
    return {
        f"{run}/{file}": hashlib.sha256((runs / run / file).read_bytes()).hexdigest()
        for run in RUNS
        for file in files
    }


def test_an_experiment_leaves_its_folder(whole):
    folder, out, err = whole
    made = folder / "experiments" / "widths"
    assert {path.name for path in made.iterdir()} - {".lock"} == {
        "experiment.json", "logs", "report.html", "runs",
    }  # fmt: skip
    assert out.splitlines() == [
        f"{STEPS} of {STEPS} steps are done", "report: experiments/widths/report.html",
    ]  # fmt: skip
    assert "train wide · seed 0: done" in err
    found = Experiment.read(made)
    assert (found.rows, found.columns, found.seeds) == (("narrow", "wide"), ("",), (0,))
    assert [run.name for cell in found.cells for run in cell.runs] == list(RUNS)
    assert all((run / "evaluation" / "summary.json").is_file() for run in (made / "runs").iterdir())
    log = (made / "logs" / "train-tiny-0.log").read_text()
    assert re.search(r"\$ acwm fit \S+/tiny.yaml training.seed=0 --out \S+/tiny-0 resume=auto", log)


def test_what_is_done_is_not_done_again(whole, acwm):
    folder, *_ = whole
    before = results(folder)
    stale = folder / "experiments" / "widths" / "logs" / "train-tiny-0.state"
    stale.write_text("running\n")
    code, out, err = acwm("experiment", "widths.yaml", cwd=folder)
    assert (code, err, stale.exists()) == (0, "", False)
    assert out.startswith(f"{STEPS} of {STEPS} steps are done, {STEPS} of them in earlier runs\n")
    code, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=folder)
    assert out.splitlines()[-1] == "nothing is left to do"
    assert out.count("done     ") == STEPS
    assert results(folder) == before


def test_killed_anywhere_it_comes_to_the_same_results(whole, acwm, tmp_path):
    """While it simulates, trains and evaluates; the last time two at once."""
    write_experiment(tmp_path)
    hold = tmp_path / HOLD
    hold.touch()
    made = tmp_path / "experiments" / "widths"
    first = made / "runs" / RUNS[0]
    for reached in (
        tmp_path / "data" / "square" / "card.yaml",
        first / "checkpoints" / "last.ckpt",
        made / "logs" / "evaluate-tiny-0.state",
    ):
        process = acwm.start("experiment", "widths.yaml", cwd=tmp_path)
        wait_until(reached.exists, process)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert saved_steps(first) < 12 or not hold.exists()
        if reached.parent.name == "checkpoints":
            hold.unlink()
    code, _, err = acwm("experiment", "widths.yaml", "--jobs", "2", cwd=tmp_path)
    assert code == 0, err
    ours, theirs = results(tmp_path), results(whole[0])
    assert ours == theirs


def test_ctrl_c_lets_a_training_save(acwm, whole, tmp_path):
    write_experiment(tmp_path, whole=whole)
    (tmp_path / HOLD).touch()
    made = tmp_path / "experiments" / "widths"
    process = acwm.start("experiment", "widths.yaml", cwd=tmp_path)
    wait_until((made / "runs" / RUNS[0] / "checkpoints" / "last.ckpt").exists, process)
    code, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=tmp_path)
    assert re.search(r"^running  train narrow · seed 0 \(\d+ of 12 steps\)$", out, re.M)
    code, _, err = acwm("experiment", "widths.yaml", cwd=tmp_path)
    assert code == 2
    assert "another command is writing to experiments/widths" in err
    process.send_signal(signal.SIGINT)
    wait_until(lambda: "stopping 1 processes, which save first" in process.stderr.readline())
    wait_until((tmp_path / HEARD).exists)  # the training waits meanwhile
    (tmp_path / HOLD).unlink()
    process.communicate(timeout=600)
    assert process.returncode == 130
    log = (made / "logs" / "train-tiny-0.log").read_text()
    assert re.search("stopped by SIGTERM, saved step 4;", log)
    assert not list((made / "logs").glob("*.state"))


def test_a_failed_run_is_told_and_tried_again(acwm, whole, tmp_path):
    """That it stops no other is what test_local proves; here the other one is done."""
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    text = EXPERIMENT.replace("narrow: tiny", "narrow: tiny model.fails=true")
    write_experiment(tmp_path, text)
    made = tmp_path / "experiments" / "widths"
    code, out, err = acwm("experiment", "widths.yaml", cwd=tmp_path)
    assert code == 1, err
    name = "train-tiny-fails-true-0"
    lines = out.splitlines()
    assert lines[0] == f"{STEPS - 2} of {STEPS} steps are done, 3 of them in earlier runs"
    assert lines[1].startswith(f"failed: {name}: ")
    assert "not finite" in lines[1]
    assert lines[1].endswith(f"(see experiments/widths/logs/{name}.log)")
    assert lines[2] == f"failed: evaluate{name[5:]}: skipped, because it needs {name}"
    assert (made / "report.html").exists()
    written = (made / "report.html").stat().st_mtime_ns
    code, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=tmp_path)
    assert code == 0
    assert re.search(r"^failed   train narrow · seed 0 \(.*not finite.*\.log\)$", out, re.M)
    code, out, err = acwm("experiment", "widths.yaml", cwd=tmp_path, FIXED="1")
    assert code == 0, out + err
    assert f"{STEPS} of {STEPS} steps are done, 3 of them in earlier runs" in out
    assert (made / "report.html").stat().st_mtime_ns > written
