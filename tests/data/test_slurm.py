"""SLURM arrays: what submitit submits is run, elements are lost and come back, the bytes agree."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from conftest import PATIENCE, checksums, wait_until

from acwm_core.cli.main import main
from acwm_core.data.generate import generate
from acwm_core.errors import DataError, RecipeError
from tests import slurm_cluster as slurm

submitit_slurm = pytest.importorskip("acwm_executors.slurm", exc_type=ImportError)
SlurmExecutor = submitit_slurm.SlurmExecutor

HERE = str(Path(__file__).parent)
pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc"),
]


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """The folder of SLURM's stand-in; its elements can import the square world."""
    here = tmp_path / "cluster"
    monkeypatch.setenv("PATH", f"{slurm.install(here)}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", HERE)
    monkeypatch.setattr(submitit_slurm, "POLL", 0.05)
    monkeypatch.setattr(submitit_slurm, "PATIENCE", 0.5)
    return here


def double(task, report):
    report(3)
    return 2 * task


def stubborn(task, report):
    os.kill(os.getpid(), signal.SIGKILL)


def slow(task, report):
    Path(task).touch()
    time.sleep(60)


def wrong(task, report):
    raise DataError(f"task {task} is impossible")


def test_arrays_make_the_same_bytes_and_lost_elements_are_submitted_again(cluster, tmp_path):
    (cluster / "unlucky").write_text("1")
    settings = {"episodes": {"train": 3}, "shard_episodes": 1, "progress": False}
    alone, out = tmp_path / "alone", tmp_path / "square"
    generate("square", alone, workers=0, **settings)
    executor = SlurmExecutor(out / ".executor", 2, "--partition=cpu --time=1:00:00")
    generate("square", out, executor=executor, **settings)
    assert checksums(out) == checksums(alone)
    assert not (out / ".executor").exists()
    first, _ = sorted(job.name for job in (cluster / "jobs").iterdir())
    asked = slurm.options(cluster, first)
    assert (asked["partition"], asked["time"], asked["cpus-per-task"]) == ("cpu", "1:00:00", "1")
    script = (cluster / "jobs" / first / "script").read_text()
    assert "#SBATCH --array=0-2%2" in script


def test_tasks_beyond_the_largest_array_share_elements(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(submitit_slurm, "MAX_ELEMENTS", 2)
    units = []
    results = SlurmExecutor(tmp_path / "job").run(double, range(5), units.append)
    assert sorted(results) == [0, 2, 4, 6, 8]
    assert sum(units) == 15
    (job,) = (cluster / "jobs").iterdir()
    assert len((job / "pids").read_text().split()) == 2


def test_what_never_comes_back_is_told(cluster, tmp_path):
    with pytest.raises(DataError, match="1 of 1 tasks have no result after 3 SLURM arrays"):
        list(SlurmExecutor(tmp_path / "job").run(stubborn, [0], lambda units: None))
    assert len(list((cluster / "jobs").iterdir())) == 3


def test_the_error_of_a_task_is_raised_and_ends_the_array(cluster, tmp_path):
    with pytest.raises(DataError, match=r"^task 0 is impossible$"):
        list(SlurmExecutor(tmp_path / "job").run(wrong, [0], lambda units: None))


def test_an_interrupted_command_cancels_its_array(cluster, tmp_path):
    marker, folder = tmp_path / "running", tmp_path / "job"
    program = f"""
import sys; sys.path.insert(0, {HERE!r})
from test_slurm import SlurmExecutor, slow
from pathlib import Path
list(SlurmExecutor(Path({str(folder)!r})).run(slow, [{str(marker)!r}], lambda units: None))
"""
    process = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
    wait_until(marker.exists, process)
    executor = SlurmExecutor(folder)
    (job,) = submitit_slurm._queue()
    with pytest.raises(DataError, match=f"SLURM job {job} of an earlier command is still running"):
        list(executor.run(double, [1], lambda units: None))
    process.send_signal(signal.SIGINT)
    process.wait(timeout=PATIENCE)
    assert slurm.state(cluster, job) == "CANCELLED"
    assert not submitit_slurm._queue()
    assert list(executor.run(double, [1], lambda units: None)) == [2]


def test_the_command_line_needs_slurm(tmp_path, monkeypatch):
    out = ["--out", str(tmp_path / "data"), "--episodes", "2"]
    monkeypatch.setenv("PATH", str(tmp_path))
    for words, message in (
        (["--executor", "slurm"], "this machine has no sbatch"),
        (["--executor", "slrum"], "unknown executor 'slrum'; did you mean 'slurm'?"),
        (["--executor", "slurm", "executor.partition=cpu"], "has no parameter 'partition'"),
        (["executor.sbatch=--time=1"], "LocalExecutor has no parameter 'sbatch'"),
        (["executor.workers=2"], "executor.workers is not an option"),
    ):
        result = CliRunner().invoke(main, ["generate", "square", *out, *words])
        assert result.exit_code == 2
        assert message in result.output


def test_what_slurm_or_the_shell_refuse_is_told(cluster, tmp_path):
    with pytest.raises(RecipeError, match="no closing quotation"):
        SlurmExecutor(tmp_path / "job", sbatch="--comment='oops")
    executor = SlurmExecutor(tmp_path / "job", sbatch="--partition=none")
    with pytest.raises(DataError, match=r"sbatch refuses the job: .*invalid partition"):
        list(executor.run(double, [1], lambda units: None))
