"""What training reads: latents instead of video, and damaged shards."""

import re
import shutil
from types import SimpleNamespace

import pytest

from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import encode_windows
from acwm_core.data.shards import open_shard
from acwm_core.errors import DataError, TrainingError
from acwm_core.training.data import ClipData
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import TinyCodec, tiny_recipe
from tests.training.runs import assert_same
from tests.training.test_processes import TWO, train

VIDEO = {"cache_latents": False}


@pytest.fixture
def shards(tmp_path):
    """Eight episodes in four shards; the last two episodes are held out."""
    folder = tmp_path / "data"
    generate(
        "tiny_world",
        folder,
        episodes={"train": 8},
        workers=0,
        shard_episodes=2,
        progress=False,
    )
    return folder


def damage(data):
    """Change a byte of the video of episode 2."""
    path = data / "train/shard-00001.tar"
    member = open_shard(path).episodes[0]["video.mkv"]
    content = bytearray(path.read_bytes())
    content[member.offset + member.size // 2] ^= 1
    path.write_bytes(content)


def test_training_on_latents_decodes_and_encodes_nothing(shards, tmp_path, monkeypatch):
    """Encoded before, as `acwm encode` does; and the run is the one that encodes by itself."""
    copy = shutil.copytree(shards, tmp_path / "copy")
    no_rollouts = {"training": {"validation_rollouts": 0}}
    whole = RunFolder(fit(tiny_recipe(copy, **no_rollouts), tmp_path / "whole"))
    encode_windows(EpisodeDataset(shards, "train"), TinyCodec(), frames=9, stride=2, progress=False)

    def never(*_):
        raise AssertionError("video was decoded or encoded")

    monkeypatch.setattr(EpisodeDataset, "video", never)
    monkeypatch.setattr(TinyCodec, "encode", never)
    assert_same(whole, RunFolder(fit(tiny_recipe(shards, **no_rollouts), tmp_path / "run")))


@pytest.mark.parametrize("data", [{}, VIDEO])
def test_a_damaged_shard_ends_training_with_its_name(shards, tmp_path, data):
    damage(shards)
    with pytest.raises(DataError, match=r"shard .*shard-00001\.tar is damaged"):
        fit(tiny_recipe(shards, data=data), tmp_path / "ends")


def test_steps_of_another_size_are_refused(shards):
    """They would go on with the very next clip, but not on the same loss curve."""
    config = DataConfig(str(shards), clip_frames=9, batch_size=4)
    data = ClipData(config, EpisodeDataset(shards, "train"), TinyCodec(), 0)
    data.trainer = SimpleNamespace(world_size=2, accumulate_grad_batches=1)
    with pytest.raises(TrainingError, match=r"takes 24 clips, but .* make 8: .* product is 24"):
        data.load_state_dict({"clips_per_step": 24})
    data.trainer.accumulate_grad_batches = 3
    data.load_state_dict({"clips_per_step": 24})
    assert data.state_dict() == {"clips_per_step": 24}


@pytest.mark.slow
def test_two_ranks_encode_together_and_train_as_one(shards, tmp_path):
    copy = shutil.copytree(shards, tmp_path / "copy")
    one = train(copy, tmp_path / "one", data={"batch_size": 4})
    assert one.returncode == 0, one.stderr
    two = train(shards, tmp_path / "two", trainer=TWO, data={"batch_size": 2})
    assert two.returncode == 0, two.stderr
    files = {path.name: path.read_bytes() for path in copy.glob("latents/*/*/*.npy")}
    assert len(files) == 4
    assert files == {path.name: path.read_bytes() for path in shards.glob("latents/*/*/*.npy")}


@pytest.mark.slow
def test_damage_that_one_rank_meets_ends_all_with_its_name(shards, tmp_path):
    damage(shards)
    done = train(shards, tmp_path / "run", trainer=TWO, data={"batch_size": 2, **VIDEO})
    assert done.returncode == 2, done.stderr
    assert re.findall(r"shard-00001\.tar is damaged", done.stderr), done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("fraction", [1.0, 0.5])
def test_a_fraction_of_the_data_leaves_validation_alone(shards, fraction):
    chosen = {"clip_frames": 9, "validation_episodes": 2, "fraction": fraction}
    config = DataConfig(str(shards), **VIDEO, **chosen)
    data = ClipData(config, EpisodeDataset(shards, "train"), TinyCodec(), 0)
    data.setup("fit")
    training = {*data._train.windows[:, 0].tolist()}
    assert len(training) == 6 * fraction
    assert training <= set(range(6))
    assert {*data._validation.windows[:, 0].tolist()} == {6, 7}
