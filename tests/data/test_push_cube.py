"""A real environment through the whole path: simulator, spawned workers, shards, clips."""

import pytest
from conftest import checksums

from acwm_core.data.episodes import ClipDataset, EpisodeDataset
from acwm_core.data.generate import generate


def test_push_cube_makes_the_same_bytes_with_any_workers(tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("taichi")
    settings = {
        "episodes": {"train": 3, "ood_test": 1},
        "size": 32,
        "shard_episodes": 2,
        "progress": False,
    }
    for workers in (0, 2):
        generate("push_cube", tmp_path / str(workers), workers=workers, **settings)
    assert checksums(tmp_path / "0") == checksums(tmp_path / "2")
    clip = ClipDataset(EpisodeDataset(tmp_path / "0", "train"))[0]
    assert clip["video"].shape == (37, 3, 32, 32)
    assert (clip["video"][0] != clip["video"][-1]).any()
