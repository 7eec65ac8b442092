"""The file of metrics, and loggers: the real packages, offline."""

import csv
import json
import shutil
import struct
import sys
from dataclasses import dataclass

import pytest
import yaml
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing import event_accumulator

from acwm_core import executors
from acwm_core.errors import MissingExtraError, TrainingError
from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from acwm_core.training.loggers import MetricsFile, build_loggers
from acwm_core.training.run_folder import RunFolder
from acwm_interventions.evaluate import evaluate_run
from acwm_zoo.packing import pack
from tests import tiny
from tests.tiny import tiny_recipe
from tests.training.runs import killable

CLASS = "lightning.pytorch.loggers.CSVLogger"


def train(data, folder, logger):
    flags = {"max_steps": 4, "accelerator": "cpu", "log_every_n_steps": 1, "logger": logger}
    fit(tiny_recipe(data, trainer=flags), folder)
    return RunFolder(folder)


def losses(run):
    with run.metrics.open(newline="") as file:
        return [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]


@pytest.mark.parametrize(
    ("chosen", "board"), [(None, True), ("csv", False), (["csv", "tensorboard"], True)]
)
def test_tensorboard_is_one_unless_others_are_chosen(chosen, board, tmp_path):
    loggers = build_loggers(RunFolder(tmp_path), {"logger": chosen}, 0)
    assert [type(each) for each in loggers] == [MetricsFile, *([TensorBoardLogger] * board)]


def test_a_class_of_lightnings_takes_its_own_arguments(data, tmp_path):
    logger = {"class_path": CLASS, "init_args": {"save_dir": str(tmp_path / "own"), "version": ""}}
    run = train(data, tmp_path / "run", logger)
    (file,) = (tmp_path / "own").rglob("metrics.csv")
    with file.open(newline="") as opened:
        rows = [row["train/loss"] for row in csv.DictReader(opened) if row["train/loss"]]
    assert [float(row) for row in rows] == losses(run)
    assert (file.parent / "hparams.yaml").read_text().count("tiny_model") == 1
    assert Recipe.from_yaml(run.recipe).trainer["logger"] == logger


@pytest.fixture(scope="module")
def drifting(tmp_path_factory, tiny_parts):
    return tiny.make_dataset(
        tmp_path_factory.mktemp("data") / "drift", train=6, ind_test=2, ood_test=2
    )


@pytest.fixture
def offline(monkeypatch):
    if wandb := sys.modules.get("wandb"):
        wandb.teardown()  # it remembers the variables of before
    for name, value in {"WANDB_MODE": "offline", "WANDB_SILENT": "true"}.items():
        monkeypatch.setenv(name, value)
    yield
    if wandb := sys.modules.get("wandb"):
        wandb.finish()


@dataclass
class Logged:
    """What a service has been told in one run of its own."""

    name: str
    losses: dict[int, float]
    model: str
    pictures: list[str]
    finished: bool


def tensorboard(run):
    size = {kind: 0 for kind in (event_accumulator.IMAGES, event_accumulator.SCALARS)}
    found = event_accumulator.EventAccumulator(str(run.path / "tensorboard"), size).Reload()
    losses = {each.step: each.value for each in found.Scalars("train/loss")}
    recipe = yaml.safe_load((run.path / "tensorboard/hparams.yaml").read_text())
    return [Logged("run", losses, recipe["model"]["name"], found.Tags()["images"], True)]


def mlflow(run):
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"file:{run.path}/mlruns")
    found = client.search_runs([client.get_experiment_by_name("acwm").experiment_id])
    return [
        Logged(
            each.info.run_name,
            {m.step: m.value for m in client.get_metric_history(each.info.run_id, "train/loss")},
            each.data.params["model/name"],
            [file.path for file in client.list_artifacts(each.info.run_id)],
            each.info.status == "FINISHED",
        )
        for each in found
    ]


def wandb(run):
    """The runs in the files that `wandb sync` would send, by their ids."""
    from wandb.proto.wandb_internal_pb2 import Record

    runs = {}
    for path in sorted((run.path / "wandb").glob("offline-run-*/run-*.wandb")):
        logged = runs.setdefault(path.stem, Logged("", {}, "", [], False))
        for data in leveldb_records(path.read_bytes()):
            record = Record.FromString(data)
            if record.run.display_name:
                logged.name = record.run.display_name
            for item in record.run.config.update or record.config.update:
                if item.key == "model":
                    logged.model = json.loads(item.value_json)["name"]
            row = {(i.key or i.nested_key[0]): i.value_json for i in record.history.item}
            if "train/loss" in row:
                logged.losses[int(row["trainer/global_step"])] = float(row["train/loss"])
            items = [[*item.nested_key] for item in record.history.item]
            logged.pictures += [keys[0] for keys in items if keys[-1:] == ["_type"]]
            logged.finished = record.WhichOneof("record_type") == "exit" or logged.finished
    return list(runs.values())


def leveldb_records(data):
    """The records of a log of LevelDB: blocks of 32 KiB with parts of (CRC-32, length, kind)."""
    place, record = 7, b""  # after a header of W&B's own
    while place < len(data):
        if 32768 - place % 32768 < 7:
            place += 32768 - place % 32768
            continue
        length, kind = struct.unpack_from("<HB", data, place + 4)
        record += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield record
            record = b""


SERVICES = {"tensorboard": tensorboard, "mlflow": mlflow, "wandb": wandb}


@pytest.mark.parametrize(
    "name",
    ["csv", "tensorboard", *(pytest.param(n, marks=pytest.mark.ci) for n in ("mlflow", "wandb"))],
)
def test_a_run_is_trained_continued_judged_and_shipped_with_each(
    name, drifting, tmp_path, offline, monkeypatch
):
    """A service sees one run, with every step, its pictures and the recipe."""
    if name in ("wandb", "mlflow"):
        pytest.importorskip(name)
    quick = {**tiny.METRICS, "metrics": ["mse"], "counterfactual_metrics": [], "videos": 0}
    quick |= {"device": "cpu", "steps_sweep": [], "perturbed_episodes": 0}
    recipe = {
        "env": {"name": "drift"},
        "codec": {"name": "blocks"},
        "model": {"name": "linear"},
        "conditioner": {"name": "linear"},
        "objective": {"steps": 2, "prediction": "clean"},
        "data": {
            "path": str(drifting),
            "clip_frames": 9,
            "batch_size": 2,
            "validation_episodes": 2,
        },
        "training": {"validate_every_n_steps": 2, "sample_every_n_steps": 2, "cpu_threads": 1},
        "trainer": {"max_steps": 2, "accelerator": "cpu", "log_every_n_steps": 1, "logger": name},
        "evaluation": quick,
    }
    run = RunFolder(fit(Recipe.from_dict(recipe), tmp_path / "run"))
    recipe["trainer"]["max_steps"] = 4
    fit(Recipe.from_dict(recipe), "", resume=run.path)  # as after a requeue, by another process
    evaluate_run(run.path, progress=False)
    assert RunFolder(pack(run.path, tmp_path / "model")).weights.is_file()
    assert len(losses(run)) == 4
    assert len([*run.samples.iterdir()]) == 2
    if name == "csv":
        return
    (found,) = SERVICES[name](run)
    assert found.name == "run"
    assert [found.losses[step] for step in range(4)] == pytest.approx(losses(run), rel=1e-6)
    assert "linear" in found.model
    assert {each.split(":")[0].split("/")[0] for each in found.pictures} >= PICTURES[name]
    assert found.finished


PICTURES = {
    "tensorboard": {"samples", "validation"},
    "mlflow": {"samples", "images"},
    "wandb": {"samples", "validation"},
}


def test_wandb_without_a_login_is_told_before_any_work(data, tmp_path, monkeypatch):
    pytest.importorskip("wandb").teardown()
    for name in ("WANDB_MODE", "WANDB_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.setattr("acwm_core.training.fit.build_world_model", None)  # not asked
    with pytest.raises(TrainingError, match=r"wandb login.*WANDB_MODE=offline"):
        train(data, tmp_path / "run", "wandb")
    assert not (tmp_path / "run").exists()


def test_a_run_of_wandb_that_was_open_before_stays_open(data, tmp_path, offline):
    """As in an agent of a sweep, which began it."""
    wandb = pytest.importorskip("wandb")
    own = wandb.init(project="mine", dir=str(tmp_path))
    train(data, tmp_path / "run", "wandb")
    assert wandb.run is own


def test_one_that_is_not_installed_names_its_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"needs 'wandb': pip install 'acwm\[wandb\]'"):
        build_loggers(RunFolder(tmp_path), {"logger": "wandb"}, 0)


def test_a_resumed_run_may_log_elsewhere(whole, data, tmp_path):
    run = RunFolder(shutil.copytree(whole.path, tmp_path / "run"))
    fit(killable(data, trainer={"max_steps": 18, "logger": "csv"}), "", resume=run.path)
    assert len(losses(run)) == 18


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_new_numbers_get_their_columns_and_old_rows_stay(tmp_path):
    path = tmp_path / "metrics.csv"
    log = MetricsFile(path)
    log.log_metrics({"train/loss": 0.1 + 0.2, "epoch": 0}, step=0)  # to the last bit
    log.log_metrics({"train/loss": 1.25, "epoch": 0}, step=1)
    log.log_metrics({"val/loss": 0.1}, step=1)
    log.log_metrics({"epoch": 0}, step=2)
    assert rows(path) == [
        {"step": "0", "train/loss": "0.30000000000000004", "val/loss": ""},
        {"step": "1", "train/loss": "1.25", "val/loss": ""},
        {"step": "1", "train/loss": "", "val/loss": "0.1"},
    ]


def test_a_resumed_run_drops_what_it_repeats(tmp_path):
    path = tmp_path / "metrics.csv"
    first = MetricsFile(path)
    for step in range(5):
        first.log_metrics({"train/loss": float(step)}, step=step)
    again = MetricsFile(path, first_step=3)
    again.log_metrics({"train/loss": 30.0}, step=3)
    wanted = {"0": "0.0", "1": "1.0", "2": "2.0", "3": "30.0"}
    assert {row["step"]: row["train/loss"] for row in rows(path)} == wanted


def test_a_fresh_run_replaces_a_stray_file(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,train/loss\n7,1.0\n")
    MetricsFile(path).log_metrics({"train/loss": 2.0}, step=0)
    assert rows(path) == [{"step": "0", "train/loss": "2.0"}]


def test_encoding_before_the_first_step_is_told_in_lines_without_a_terminal(
    data, tmp_path, monkeypatch, capsys
):
    """With latents that no other test has made, by their gain."""
    monkeypatch.setattr(executors, "LINE_EVERY_S", 0)
    fit(tiny_recipe(data, codec={"gain": 1.7}, trainer={"max_steps": 1}), tmp_path / "run")
    said = capsys.readouterr().err.splitlines()
    lines = [line.split()[:4] for line in said if line.startswith("encoding train  ")]
    assert lines[:8] == [["encoding", "train", f"{n}/8", "episodes"] for n in range(1, 9)]
