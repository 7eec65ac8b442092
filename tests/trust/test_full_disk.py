"""A disk that fills up under each command: one sentence, nothing half-written, no crash."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.generate import generate
from acwm_core.files import disk_error, made_whole, written_whole
from tests.report.synthetic import clips, run
from tests.tiny import make_slide_run, register, tiny_recipe

HERE = Path(__file__).parents[1] / "reference/first_release"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return run(tmp_path_factory.mktemp("results") / "run", clips([20.0, 21.0, 22.0]))


@pytest.fixture
def release(tmp_path):
    """Evaluations keep references there."""
    return shutil.copytree(HERE, tmp_path / "release")


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    """Of the smallest parts there are, and their dataset."""
    register()
    folder = tmp_path_factory.mktemp("tiny")
    generate("tiny_world", folder / "data", episodes={"train": 4}, workers=0, progress=False)
    often = {"checkpoint_every_n_steps": 2, "validate_every_n_steps": 4, "sample_every_n_steps": 4}
    made = tiny_recipe(folder / "data", training=often, trainer={"max_steps": 6})
    (folder / "recipe.yaml").write_text(made.to_yaml())
    return folder / "recipe.yaml"


@pytest.fixture(scope="module")
def acting(tmp_path_factory):
    """A run whose model acts in a small world."""
    register()
    torch.set_num_threads(1)
    return make_slide_run(tmp_path_factory.mktemp("acting"), episodes=2)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Those of a dataset, as LeRobot stores them."""
    home = tmp_path_factory.mktemp("lerobot")
    data, folder = shutil.copytree(HERE / "data", home / "data"), home / "recordings"
    words = ["data", "export", "lerobot", str(data), "--out", str(folder)]
    assert CliRunner().invoke(main, words).exit_code == 0
    return folder


def on_disks(tmp_path, sizes, *command, before=""):
    """How the command ends on disks of these sizes in kB, beside what they hold `before`."""
    if shutil.which("unshare") is None:
        pytest.skip("this system has no unshare")
    alone = ["unshare", "--map-root-user", "--mount"]
    tried = [*alone, "mount", "-t", "tmpfs", "tmpfs", tmp_path]
    if subprocess.run(tried, check=False, capture_output=True).returncode:
        pytest.skip("this user may not mount a disk of its own")
    program = [sys.executable, Path(__file__).with_name("filling.py"), tmp_path]
    done = subprocess.run(
        [*alone, *program, ",".join(map(str, sizes)), before, *map(str, command)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])  # -11 is a crash
    return [json.loads(line) for line in done.stdout.splitlines()]


def one_sentence(disks):
    """Those that are too small say so, and leave nothing half-written."""
    for disk in disks:
        assert not [file for file in disk["files"] if ".partial" in file], disk
        if disk["code"]:
            assert disk["code"] == 2, disk
            assert disk["said"].splitlines()[-1].startswith("acwm: "), disk
            assert "No space left on device" in disk["said"], disk
            assert "Traceback" not in disk["said"]
        assert disk["again"] == 0, disk  # with room, the same command goes on
        assert not [file for file in disk.get("whole", ()) if ".partial" in file], disk
    assert disks[0]["code"] == 2
    assert disks[-1]["code"] == 0, disks[-1]


QUICK = (
    "evaluation.episodes=2 evaluation.counterfactual_episodes=0 evaluation.steps=1 "
    "evaluation.perturbed_episodes=0 evaluation.steps_sweep=[] evaluation.metrics=[psnr] "
    "evaluation.counterfactual_metrics=[]"
)
ACT = "planner.candidates=4 planner.iterations=1 planner.elites=2 planner.horizon=2"

COMMANDS = {
    "report": "report {results} --out DISK/report.html",
    "hdf5": "data export hdf5 {release}/data --out DISK/out",
    "leaderboard": "leaderboard {results} --out DISK/board.html",
    "new": "new environment open_drawer --out DISK/a/drawer",
    "export": "report {results} --out DISK/r.html --export DISK/tables",
    "lerobot": "data export lerobot {release}/data --out DISK/out",
    "preview": "data preview {release}/data --out DISK/out",
    "rollout": "rollout {release}/run --data {release}/data --out DISK/rollout.mp4",
    "strip": "rollout {release}/run --data {release}/data --out DISK/r.png",
    "evaluate": f"evaluate {{release}}/run {QUICK} --data {{release}}/data --out DISK/scores",
    "encode": "encode DISK/before --split all --codec compact --frames 9",
    "import": "data import lerobot {recordings} --workers 0 --out DISK/out",
    "fit": "fit {recipe} resume=auto --out DISK/run",
    "plan": f"plan {{acting}} place {ACT} --videos 1 --out DISK/out",
    "rank": "rank {acting} place --policies solution --policies behaviour --seeds 0 --out DISK/out",
    "ship": f"ship {{acting}} evaluation.splits=[train] {QUICK} --out DISK/model",
}
USUAL = ("report", "hdf5")
"""Those that write a file, and a folder of them; the others are tried by `make test-all`."""


@pytest.mark.parametrize(
    "name",
    [name if name in USUAL else pytest.param(name, marks=pytest.mark.slow) for name in COMMANDS],
)
@pytest.mark.ci
def test_disks_of_many_sizes(name, request, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    words = []
    for word in shlex.split(COMMANDS[name]):
        places = {each: request.getfixturevalue(each) for each in re.findall(r"{(\w+)}", word)}
        words.append(word.format(**places))
    sizes = (4, 40, 20_000) if name in USUAL else (0, 8, 24, 40, 80, 140, 200, 400, 20_000)
    disks = on_disks(disk, sizes, *words, before=str(HERE / "data") if name == "encode" else "")
    one_sentence(disks)
    if name == "fit":  # no checkpoint is cut short, and those that fit in are kept
        kept = [any(file.endswith("last.ckpt") for file in disk["files"]) for disk in disks]
        assert kept == sorted(kept)
        assert any(kept[:-1])


def test_a_refusal_without_a_number_is_the_disks_if_it_is_full(tmp_path, monkeypatch):
    """As those of PyTorch and safetensors are."""

    def save():
        with written_whole(tmp_path / "x") as partial:
            partial.write_text("so far")
            raise RuntimeError("unexpected pos 64 vs 0")

    with pytest.raises(RuntimeError):
        save()
    full = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr("acwm_core.files.shutil.disk_usage", lambda place: full)
    with pytest.raises(OSError, match="No space left on device"):
        save()
    assert list(tmp_path.iterdir()) == []


def test_errors_of_our_own_are_not_the_disks(tmp_path):
    assert disk_error(ValueError("no")) is None
    with pytest.raises(KeyError), made_whole(tmp_path / "x"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []
