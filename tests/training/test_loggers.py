"""The file of metrics, and loggers: the real packages, offline."""

import csv
import shutil

import pytest
from lightning.pytorch.loggers import TensorBoardLogger

from acwm_core import executors
from acwm_core.errors import MissingExtraError
from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from acwm_core.training.loggers import MetricsFile, build_loggers
from acwm_core.training.run_folder import RunFolder
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


def test_mlflow_has_the_losses_and_the_recipe(data, tmp_path):
    run = train(data, tmp_path / "run", "mlflow")
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"file:{run.path}/mlruns")
    experiment = client.get_experiment_by_name("acwm")
    (found,) = client.search_runs([experiment.experiment_id])
    assert (found.info.run_name, found.info.status) == ("run", "FINISHED")
    history = client.get_metric_history(found.info.run_id, "train/loss")
    assert [each.value for each in history] == losses(run)
    assert found.data.params["model/name"] == "tiny_model"


def test_wandb_has_the_losses_and_the_recipe(data, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    import wandb

    try:
        run = train(data, tmp_path / "run", "wandb")
        logged = wandb.run
        assert logged is not None
        assert (logged.name, logged.project) == ("run", "acwm")
        assert logged.summary["train/loss"] == pytest.approx(losses(run)[-1])
        assert logged.config["model"]["name"] == "tiny_model"
    finally:
        wandb.finish()
    assert [*(run.path / "wandb").glob("offline-run-*/run-*.wandb")]


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
