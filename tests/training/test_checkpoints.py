"""A checkpoint takes the place of the last one; killed at any moment, one of them is whole."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.distributed.checkpoint.api import CheckpointException

from acwm_core.errors import TrainingError
from acwm_core.training import checkpoints
from acwm_core.training.checkpoints import (
    check_sums,
    last_whole,
    read_details,
    read_whole,
    write_file,
    write_folder,
)
from acwm_core.training.config import TrainingConfig
from acwm_core.training.module import TrainingModule
from acwm_core.training.sharding import ShardedStrategy
from tests.tiny import tiny_world_model


class Died(BaseException):
    """The end of the process."""


def write(kind: str, path: Path, step: int) -> None:
    """A checkpoint of either kind that says which step it is of."""
    value = torch.full((3,), float(step))
    checkpoint = {"global_step": step, "state_dict": {"world_model.weight": value}}
    if kind == "file":
        write_file(path, checkpoint)
    else:
        groups = [{"lr": 0.1, "params": ["world_model.weight"]}]
        optimizer = {"state": {}, "param_groups": groups}
        write_folder(path, checkpoint, optimizer, SingleDeviceStrategy())


def dies_at(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process die before its `number`-th change of names in the file system."""
    changes = iter(range(1000))
    for owner, name in ((Path, "rename"), (Path, "replace"), (checkpoints, "_remove")):
        original = getattr(owner, name)

        def change(*args, original=original):
            if next(changes) == number:
                raise Died
            return original(*args)

        monkeypatch.setattr(owner, name, change)


@pytest.mark.parametrize("after", ["file", "folder"])
@pytest.mark.parametrize("before", ["file", "folder"])
def test_one_is_whole_whenever_the_process_dies(before, after, tmp_path):
    steps = []
    for number in range(7):
        path = tmp_path / str(number) / "last.ckpt"
        write(before, path, 1)
        with pytest.MonkeyPatch.context() as patch:
            dies_at(number, patch)
            with contextlib.suppress(Died, CheckpointException):
                write(after, path, 2)
        checkpoint = read_whole(last_whole(path))
        steps.append(checkpoint["global_step"])
        value = checkpoint["state_dict"]["world_model.weight"]
        assert torch.equal(value, torch.full((3,), float(steps[-1])))
        write(after, path, 3)  # the next one puts all in order
        assert read_details(last_whole(path))["global_step"] == 3
        assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]
    assert steps == sorted(steps)
    assert set(steps) == {1, 2}


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_every_byte_that_was_changed_is_found(kind, tmp_path):
    path = tmp_path / "last.ckpt"
    write(kind, path, 1)
    check_sums(path)
    parts = [path] if kind == "file" else [*path.glob("*.distcp"), path / "meta.pt"]
    value = np.full(3, 1, np.float32).tobytes()
    assert any(value in part.read_bytes() for part in parts)
    for part in parts:
        whole = part.read_bytes()
        for place in (whole.find(value), whole.find(b"global_step")):
            if place >= 0:
                part.write_bytes(whole[:place] + b"\x01" + whole[place + 1 :])
                with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
                    check_sums(path)
        part.write_bytes(whole[:-30])
        with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
            check_sums(path)
        part.write_bytes(whole)
    check_sums(path)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_sharded_training_refuses_weights_that_lack_any(kind, tmp_path, monkeypatch):
    task = TrainingModule(tiny_world_model(), TrainingConfig())
    strategy = ShardedStrategy()
    strategy.model = task
    strategy.optimizers = [torch.optim.AdamW(task.world_model.model.parameters())]
    monkeypatch.setattr(strategy, "broadcast", lambda path: path)
    path = tmp_path / "last.ckpt"
    write(kind, path, 1)
    with pytest.raises((TrainingError, CheckpointException), match=r"averaged\."):
        strategy.load_checkpoint(path)
