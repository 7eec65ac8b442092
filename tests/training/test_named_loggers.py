"""Loggers by name or as Lightning's classes, with the real packages, offline."""

import csv
import sys

import pytest

from acwm_core.errors import MissingExtraError, RecipeError
from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from acwm_core.training.run import RunFolder
from tests.tiny import tiny_recipe

CLASS = "lightning.pytorch.loggers.CSVLogger"


def train(data, folder, logger):
    flags = {"max_steps": 4, "accelerator": "cpu", "log_every_n_steps": 1, "logger": logger}
    fit(tiny_recipe(data, trainer=flags), folder)
    return RunFolder(folder)


def losses(run):
    with run.metrics.open(newline="") as file:
        return [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]


def test_csv_alone_leaves_no_event_files(data, tmp_path):
    run = train(data, tmp_path / "run", "csv")
    assert len(losses(run)) == 4
    assert not (run.path / "tensorboard").exists()


def test_tensorboard_by_name_is_what_runs_have_anyway(data, tmp_path):
    for name, logger in (("named", ["csv", "tensorboard"]), ("default", None)):
        run = train(data, tmp_path / name, logger)
        assert len(losses(run)) == 4
        assert [*(run.path / "tensorboard").glob("events*")]


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


def test_one_that_is_not_installed_names_its_extra(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"needs 'wandb': pip install 'acwm\[wandb\]'"):
        train(data, tmp_path / "run", "wandb")


@pytest.mark.parametrize(
    ("logger", "message"),
    [
        ("wandbb", "unknown logger 'wandbb'; did you mean 'wandb'"),
        (["csv", "nonsuch"], "unknown logger 'nonsuch'; known: csv, mlflow"),
        ({"class_path": "lightning.pytorch.loggers.NoLogger"}, "invalid section trainer"),
    ],
)
def test_wrong_ones_are_refused(data, tmp_path, logger, message):
    with pytest.raises(RecipeError, match=message):
        train(data, tmp_path / "run", logger)


def test_a_resumed_run_may_log_elsewhere(data, tmp_path):
    flags = {"max_steps": 4, "accelerator": "cpu", "log_every_n_steps": 1}
    fit(tiny_recipe(data, trainer=flags), tmp_path / "run")
    more = {**flags, "max_steps": 6, "logger": "csv"}
    recipe = tiny_recipe(data, trainer=more, training={"schedule": "constant"})
    first = tiny_recipe(data, trainer=flags, training={"schedule": "constant"})
    run = fit(first, tmp_path / "again")
    fit(recipe, run, resume=run)
    assert len(losses(RunFolder(run))) == 6
