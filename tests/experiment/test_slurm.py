"""SLURM jobs: the written scripts are run, in order, queued again after a preemption, or fail."""

import json
import os

import pytest

from tests import slurm_cluster as slurm
from tests.experiment.parts import EXPERIMENT, HEARD, HOLD, write_experiment
from tests.experiment.test_running import STEPS, results
from tests.folders import wait_until

SLURM = ("--executor", "slurm")
pytestmark = pytest.mark.ci


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """The folder of SLURM's stand-in, whose commands are found first."""
    here = tmp_path / "slurm"
    monkeypatch.setenv("PATH", f"{slurm.install(here)}{os.pathsep}{os.environ['PATH']}")
    return here


def all_ended(cluster):
    return lambda: all(
        slurm.state(cluster, job.name) in slurm.ENDED for job in (cluster / "jobs").iterdir()
    )


def job_of(folder, step):
    return (folder / "experiments/widths/jobs/slurm" / f"{step}.job").read_text().split()[0]


def test_jobs_wait_for_one_another_and_survive_a_preemption(acwm, cluster, whole, tmp_path):
    """The results are those of the same experiment on this machine."""
    ours, theirs = tmp_path / "slurm_run", whole[0]
    write_experiment(ours)
    (ours / HOLD).touch()
    options = ["executor.sbatch=--partition=gpu", "executor.steps.train=--time=1:00 --mem=4G"]
    code, out, err = acwm("experiment", "widths.yaml", *SLURM, *options, cwd=ours)
    assert code == 0, err
    assert out == f"{STEPS} jobs submitted; --plan shows their progress\n"
    train, evaluate = job_of(ours, "train-tiny-0"), job_of(ours, "evaluate-tiny-0")
    simulate = job_of(ours, "simulate-data_square")
    asked = slurm.options(cluster, train)
    assert (asked["time"], asked["mem"], asked["partition"]) == ("1:00", "4G", "gpu")
    assert (asked["dependency"], asked["signal"]) == (f"afterok:{simulate}", "USR1@300")
    asked = slurm.options(cluster, evaluate)
    assert (asked["dependency"], asked["partition"]) == (f"afterok:{simulate}:{train}", "gpu")
    assert "time" not in asked

    run = ours / "experiments" / "widths" / "runs" / "tiny-0"
    wait_until((run / "checkpoints" / "last.ckpt").exists)
    _, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=ours)
    assert f"running  train narrow · seed 0 (job {train}" in out
    assert f"queued   evaluate narrow · seed 0 (job {evaluate})" in out
    code, _, err = acwm("experiment", "widths.yaml", cwd=ours)
    assert code == 2
    assert "jobs of this experiment are in the queue" in err
    assert acwm("experiment", "widths.yaml", *SLURM, cwd=ours)[1].startswith("0 jobs")
    slurm.preempt(cluster, train)
    wait_until((ours / HEARD).exists)  # the training waits meanwhile
    (ours / HOLD).unlink()
    wait_until(all_ended(cluster))
    log = (ours / "experiments" / "widths" / "logs" / "train-tiny-0.log").read_text()
    assert f"SLURM job {train} was requeued" in log
    assert log.count("$ acwm fit") == 2
    assert results(ours) == results(theirs)
    _, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=ours)
    assert out.splitlines()[-1] == "nothing is left to do"


@pytest.mark.slow
def test_a_failed_job_takes_only_its_own_with_it(acwm, cluster, tmp_path):
    write_experiment(tmp_path, EXPERIMENT.replace("narrow: tiny", "narrow: tiny model.fails=true"))
    made = tmp_path / "experiments" / "widths"
    for out in ("widths", "again"):  # the second waits until the first has made the data
        words = ("experiment", "widths.yaml", *SLURM, "--out", f"experiments/{out}")
        code, _, err = acwm(*words, cwd=tmp_path)
        assert code == 0, err
    wait_until(all_ended(cluster))
    assert (tmp_path / "experiments" / "again" / "report.html").exists()
    failed = "tiny-fails-true-0"
    simulation = job_of(tmp_path, "simulate-data_square")
    assert slurm.options(cluster, simulation)["dependency"] == "singleton"
    assert slurm.state(cluster, job_of(tmp_path, f"train-{failed}")) == "FAILED"
    assert slurm.state(cluster, job_of(tmp_path, f"evaluate-{failed}")) == "CANCELLED"
    assert (made / "report.html").exists()
    _, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=tmp_path)
    assert "failed   train narrow · seed 0 (" in out
    assert "to do    evaluate narrow · seed 0" in out

    code, out, err = acwm(
        "experiment", "widths.yaml", "--executor", "slurm", cwd=tmp_path, FIXED="1"
    )
    assert (code, out[:6]) == (0, "3 jobs"), err
    wait_until(all_ended(cluster))
    assert json.loads((made / "runs" / failed / "evaluation" / "summary.json").read_text())
