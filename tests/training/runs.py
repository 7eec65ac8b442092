"""Runs that are killed and resumed, and what two runs have in common."""

import csv

import pytest
import torch

from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.callbacks import Kill, Killed


def killable(data, /, **sections):
    """A recipe with dropout, several passes over the data and a callback that can kill it."""
    trainer = {"callbacks": [{"class_path": "tests.training.callbacks.Kill"}]}
    return tiny_recipe(data, trainer={**trainer, **sections.pop("trainer", {})}, **sections)


def killed_run(data, folder, monkeypatch, /, **sections):
    with pytest.raises(Killed):
        fit(killable(data, **sections), folder)
    monkeypatch.setattr(Kill, "batch", None)
    return RunFolder(folder)


def assert_same(one: RunFolder, other: RunFolder):
    """The same curve to the last bit, and the same weights and averages."""
    assert numbers(one) == numbers(other)
    theirs, ours = weights(one), weights(other)
    assert theirs.keys() == ours.keys()
    assert all(torch.equal(theirs[name], ours[name]) for name in theirs)


def numbers(run: RunFolder) -> dict[tuple[str, str], str]:
    """Every logged number as text by step and name."""
    with run.metrics.open() as file:
        return {
            (row["step"], name): value
            for row in csv.DictReader(file)
            for name, value in row.items()
            if value
        }


def weights(run: RunFolder) -> dict[str, torch.Tensor]:
    return torch.load(run.last_checkpoint, weights_only=True)["state_dict"]
