"""SLURM arrays: the written scripts are run, elements are lost and come back, the bytes agree."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import slurm_on_this_machine as slurm
from click.testing import CliRunner
from conftest import EPISODES, checksums

from acwm_core.cli.main import main
from acwm_core.data.generate import generate
from acwm_core.data.slurm_executor import SlurmExecutor, in_queue
from acwm_core.errors import DataError, RecipeError

HERE = str(Path(__file__).parent)
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """The folder of SLURM's commands; its elements can import the square world."""
    folder = tmp_path / "bin"
    slurm.install(folder)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", HERE)
    return folder


def executor(folder, options="", **settings):
    return SlurmExecutor(folder, options, poll=0.05, **({"patience": 1.0} | settings))


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


def test_arrays_make_the_same_bytes(cluster, square_data, tmp_path):
    out = tmp_path / "square"
    generate(
        "square",
        out,
        episodes=EPISODES,
        shard_episodes=4,
        executor=executor(out / ".slurm", "--partition=cpu --time=1:00:00"),
        progress=False,
    )
    assert checksums(out) == checksums(square_data)
    assert not (out / ".slurm").exists()
    options = (cluster / "options").read_text()
    assert options.startswith("--parsable --partition=cpu --time=1:00:00 ")


def test_lost_elements_are_submitted_again(cluster, tmp_path):
    (cluster / "unlucky").write_text("1 3")
    units = []
    results = executor(tmp_path / "job").run(double, [0, 1, 2, 3, 4], units.append)
    assert sorted(results) == [0, 2, 4, 6, 8]
    assert len(list((cluster / "jobs").iterdir())) == 2
    assert sum(units) == 15


def test_tasks_beyond_the_largest_array_share_elements(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("acwm_core.data.slurm_executor.LARGEST_ARRAY", 2)
    results = executor(tmp_path / "job").run(double, range(5), lambda units: None)
    assert sorted(results) == [0, 2, 4, 6, 8]
    (job,) = (cluster / "jobs").iterdir()
    assert len(job.read_text().split()) == 2


def test_what_never_comes_back_is_told(cluster, tmp_path):
    with pytest.raises(DataError, match="1 of 1 tasks did not come back from 3 SLURM arrays"):
        list(executor(tmp_path / "job", patience=0.2).run(stubborn, [0], lambda units: None))
    assert len(list((cluster / "jobs").iterdir())) == 3


def test_the_error_of_a_task_is_raised_and_ends_the_array(cluster, tmp_path):
    with pytest.raises(DataError, match=r"^task 0 is impossible$"):
        list(executor(tmp_path / "job").run(wrong, [0], lambda units: None))


def test_an_interrupted_command_cancels_its_array(cluster, tmp_path):
    marker, folder = tmp_path / "running", tmp_path / "job"
    program = f"""
import sys; sys.path.insert(0, {HERE!r})
from test_slurm import executor, slow
from pathlib import Path
list(executor(Path({str(folder)!r})).run(slow, [{str(marker)!r}], lambda units: None))
"""
    process = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not marker.exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    job = (folder / "job.id").read_text()
    assert in_queue(job)
    with pytest.raises(DataError, match=f"SLURM job {job} of an earlier command is still at it"):
        executor(folder)
    process.send_signal(signal.SIGINT)
    process.wait(timeout=20)
    while in_queue(job):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert not list(executor(folder).run(double, [], lambda units: None))


def test_the_command_line_needs_slurm(tmp_path, monkeypatch):
    out = ["--out", str(tmp_path / "data"), "--episodes", "2", "--executor", "slurm"]
    monkeypatch.setenv("PATH", str(tmp_path))
    result = CliRunner().invoke(main, ["generate", "square", *out], standalone_mode=True)
    assert result.exit_code == 2
    assert "this machine has no sbatch" in result.output
    result = CliRunner().invoke(main, ["generate", "square", "--sbatch", "--time=1"])
    assert result.exit_code == 2
    assert "--sbatch is for --executor slurm" in result.output


def test_options_must_be_quoted_well(cluster, tmp_path):
    with pytest.raises(RecipeError, match="no closing quotation"):
        executor(tmp_path / "job", "--comment='oops")
