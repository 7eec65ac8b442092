"""Checkpoints in a stranger's run folder: resuming runs nothing that they hold."""

import os
import pickle
import shutil

import pytest
import torch
import torch.distributed.checkpoint as dcp
from lightning.pytorch.strategies import SingleDeviceStrategy

from acwm_core.errors import TrainingError
from acwm_core.training.checkpoints import read_details, read_shares, read_whole, write_folder
from acwm_core.training.fit import fit
from tests.tiny import tiny_recipe

FORMATS = dcp.metadata._MEM_FORMAT_ENCODING


class Attack:
    """Makes a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


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


@pytest.mark.parametrize("protocol", range(2, 6))
def test_an_attack_within_a_sound_index(tmp_path, protocol):
    path, mark = folder(tmp_path / "last.ckpt"), tmp_path / "mark"
    found = index(path)
    found.planner_data = Attack(mark)
    (path / ".metadata").write_bytes(pickle.dumps(found, protocol))
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


def with_attribute(path, owner, name):
    found = index(folder(path))
    found.planner_data = Attribute(owner, name)
    (path / ".metadata").write_bytes(pickle.dumps(found))
    return path


def test_members_of_an_enum_are_read_as_any_python_writes_them(tmp_path):
    read(with_attribute(tmp_path / "last.ckpt", FORMATS, "TORCH_PRESERVE_FORMAT"))


@pytest.mark.parametrize(("owner", "name"), [(FORMATS, "__init__"), (torch.Size, "numel")])
def test_other_attributes_are_refused(tmp_path, owner, name):
    path = with_attribute(tmp_path / "last.ckpt", owner, name)
    with pytest.raises(TrainingError, match=name):
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


@pytest.mark.parametrize("resume", ["auto", "run"])
def test_resuming_a_strangers_run_runs_nothing(data, tmp_path, resume):
    run, mark = tmp_path / "run", tmp_path / "mark"
    recipe = tiny_recipe(data, trainer={"max_steps": 5})
    for place in (".metadata", "meta.pt"):
        checkpoint = folder(run / "checkpoints" / "last.ckpt")
        (run / "recipe.yaml").write_text(recipe.to_yaml())
        shutil.copy(data / "card.yaml", run)
        (checkpoint / place).write_bytes(pickle.dumps(Attack(mark)))
        with pytest.raises(TrainingError, match=r"cannot be read|is damaged"):
            fit(recipe, run, resume="auto" if resume == "auto" else run)
        assert not mark.exists()
