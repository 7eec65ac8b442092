"""Checkpoints: one of the last two is whole at any moment, and reading them runs nothing."""

import contextlib
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed.checkpoint as dcp
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.distributed.checkpoint.api import CheckpointException

from acwm_core.errors import TrainingError
from acwm_core.training import checkpoints
from acwm_core.training.checkpoints import (
    check_sums,
    last_whole,
    read_details,
    read_shares,
    read_step,
    read_whole,
    write_file,
    write_folder,
)
from acwm_core.training.config import TrainingConfig
from acwm_core.training.fit import fit
from acwm_core.training.module import TrainingModule
from acwm_core.training.sharding import ShardedStrategy
from tests.plugins import Attack
from tests.tiny import tiny_recipe, tiny_world_model


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


FORMATS = dcp.metadata._MEM_FORMAT_ENCODING


def folder(path):
    """A folder checkpoint with a weight and its optimiser's state."""
    weight = torch.arange(4.0).reshape(2, 2)
    checkpoint = {"global_step": 3, "state_dict": {"w.model.a": weight}}
    groups = [{"lr": 0.1, "params": ["w.model.a"]}]
    state = {"w.model.a": {"exp_avg": weight.bfloat16(), "step": torch.tensor(3.0)}}
    optimizer = {"state": state, "param_groups": groups}
    write_folder(path, checkpoint, optimizer, SingleDeviceStrategy())
    return path


def read(path):
    """Everything by which a run resumes."""
    read_details(path)
    read_whole(path)


def index(path):
    return pickle.loads((path / ".metadata").read_bytes())


def test_a_sound_folder_is_read(tmp_path):
    found = read_whole(folder(tmp_path / "last.ckpt"))
    assert found["state_dict"]["w.model.a"].tolist() == [[0, 1], [2, 3]]
    (states,) = found["optimizer_states"]
    assert states["state"][0]["exp_avg"].dtype == torch.bfloat16
    assert states["state"][0]["step"] == 3


@pytest.mark.parametrize("place", [".metadata", "meta.pt", "__0_0.distcp"])
def test_nothing_is_unpickled_but_what_is_allowed(tmp_path, place):
    path, mark = folder(tmp_path / "last.ckpt"), tmp_path / "mark"
    content = pickle.dumps(Attack(mark))
    (path / place).write_bytes(content)
    with pytest.raises(TrainingError, match=r"cannot be read|is damaged") as raised:
        read(path)
    assert "\n" not in str(raised.value)
    assert not mark.exists()
    pickle.loads(content)
    assert mark.exists()  # the attack is real


def test_an_attack_within_a_sound_index(tmp_path):
    path, mark = folder(tmp_path / "last.ckpt"), tmp_path / "mark"
    found = index(path)
    found.planner_data = Attack(mark)
    (path / ".metadata").write_bytes(pickle.dumps(found))
    with pytest.raises(TrainingError, match="which is not run"):
        read(path)
    with pytest.raises(TrainingError, match="which is not run"):  # as sharded training reads it
        read_shares(path, {"model.w.model.a": torch.zeros(2, 2)}, no_dist=True)
    assert not mark.exists()


class Attribute:
    """Pickled as Python before 3.11.4 pickles the member of an enum."""

    def __init__(self, owner, name):
        self.of = owner, name

    def __reduce__(self):
        return getattr, self.of


@pytest.mark.parametrize(
    ("owner", "name", "is_read"),
    [
        (FORMATS, "TORCH_PRESERVE_FORMAT", True),
        (FORMATS, "__init__", False),
        (torch.Size, "numel", False),
    ],
)
def test_only_members_of_an_enum_are_read_as_any_python_writes_them(owner, name, is_read, tmp_path):
    path = folder(tmp_path / "last.ckpt")
    found = index(path)
    found.planner_data = Attribute(owner, name)
    (path / ".metadata").write_bytes(pickle.dumps(found))
    with contextlib.nullcontext() if is_read else pytest.raises(TrainingError, match=name):
        read(path)


def test_pickled_bytes_among_the_tensors(tmp_path):
    """PyTorch unpickles what is no tensor with all that it names."""
    path, mark = folder(tmp_path / "last.ckpt"), tmp_path / "mark"
    (path / ".metadata").unlink()
    dcp.save({"model.w.model.a": torch.zeros(2), "evil": Attack(mark)}, checkpoint_id=path)
    with pytest.raises(TrainingError, match=r"cannot be read|is damaged"):
        read(path)
    assert not mark.exists()


def test_shards_in_other_folders_are_refused(tmp_path):
    path = folder(tmp_path / "last.ckpt")
    found = index(path)
    for place in found.storage_data.values():
        place.relative_path = "../../secret"
    (path / ".metadata").write_bytes(pickle.dumps(found))
    with pytest.raises(TrainingError, match="files of other folders"):
        read(path)


def test_resuming_a_strangers_run_runs_nothing(data, tmp_path):
    run, mark = tmp_path / "run", tmp_path / "mark"
    recipe = tiny_recipe(data, trainer={"max_steps": 5})
    for place in (".metadata", "meta.pt"):
        checkpoint = folder(run / "checkpoints" / "last.ckpt")
        (run / "recipe.yaml").write_text(recipe.to_yaml())
        shutil.copy(data / "card.yaml", run)
        (checkpoint / place).write_bytes(pickle.dumps(Attack(mark)))
        with pytest.raises(TrainingError, match=r"cannot be read|is damaged"):
            fit(recipe, run, resume=run)
        assert not mark.exists()


@pytest.mark.parametrize("step", [-5, 2.5, None])
def test_a_number_of_steps_that_cannot_be_is_damage(tmp_path, step):
    torch.save({"global_step": step}, tmp_path / "last.ckpt")
    with pytest.raises(TrainingError, match=r"last\.ckpt is damaged .*global_step"):
        read_step(tmp_path / "last.ckpt")
    torch.save([step], tmp_path / "last.ckpt")
    with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
        read_step(tmp_path / "last.ckpt")
