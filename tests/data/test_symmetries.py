"""Clips transformed by symmetries: as video, streamed and as latents; and what asks for them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from blocks import Blocks
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.data.streaming import ClipStream
from acwm_core.env.symmetry import Symmetry, group
from acwm_core.errors import DataError

SYMMETRIES = group(
    Symmetry((-1, 2), mirrored=True), Symmetry((-2, 1), quarter_turns=1)
)  # not those of the square, but clips are transformed by what is asked for
WINDOWS = {"frames": 9, "stride": 4}


@pytest.fixture
def data(tmp_path):
    episodes = {"train": 3}
    generate("square", tmp_path / "data", episodes=episodes, workers=0, progress=False)
    return EpisodeDataset(tmp_path / "data", "train")


def test_every_window_comes_once_by_each_symmetry_with_its_actions(data):
    plain, clips = ClipDataset(data, **WINDOWS), ClipDataset(data, **WINDOWS, symmetries=SYMMETRIES)
    assert len(clips) == 8 * len(plain)
    for index in range(len(clips)):
        usual, found = plain[index // 8], clips[index]
        video, actions = usual["video"], usual["actions"]
        if symmetry := clips.version(index):
            video = video.flip(-1) if symmetry.mirrored else video
            video = torch.rot90(video, symmetry.quarter_turns, (-2, -1))
            actions = actions @ torch.as_tensor(symmetry.plane.T, dtype=torch.float32)
        assert torch.equal(found["video"], video)
        assert torch.equal(found["actions"], actions)


def test_latents_are_those_of_the_transformed_video(data):
    clips, codec = ClipDataset(data, **WINDOWS, symmetries=SYMMETRIES), Blocks()
    for symmetry in (None, *SYMMETRIES):
        encode_windows(data, codec, symmetry=symmetry, progress=False, **WINDOWS)
    latents = LatentClipDataset(data, codec.fingerprint(), **WINDOWS, symmetries=SYMMETRIES)
    for index in range(len(clips)):
        expected = codec.encode(clips[index]["video"][None].float() / 255)[0]
        found = latents[index]
        torch.testing.assert_close(found["latents"].float(), expected, rtol=1e-3, atol=1e-3)
        assert torch.equal(found["actions"], clips[index]["actions"])


def test_latents_that_were_not_transformed_are_missed(data):
    encode_windows(data, Blocks(), progress=False, **WINDOWS)
    with pytest.raises(DataError, match="mirrored"):
        LatentClipDataset(data, Blocks().fingerprint(), **WINDOWS, symmetries=SYMMETRIES)


def test_streamed_clips_are_transformed_too(data):
    clips = ClipDataset(data, **WINDOWS, symmetries=SYMMETRIES)
    sampler = ClipSampler(len(clips), batch_size=len(clips))
    batch = next(iter(ClipLoader(ClipStream(clips, sampler), sampler)))

    def known(video, actions):
        return video.numpy().tobytes() + actions.numpy().tobytes()

    found = set(map(known, batch["video"], batch["actions"]))
    each = (clips[index] for index in range(len(clips)))
    assert found == {known(clip["video"], clip["actions"]) for clip in each}


def test_the_command_encodes_each_symmetry(data):
    card = DatasetCard.read(data.path)
    arguments = [str(data.path), "--codec", "identity", "--frames", "9", "--symmetries"]
    refused = CliRunner().invoke(main, ["encode", *arguments])
    assert refused.exit_code == 2
    assert "declares no symmetries" in refused.output
    replace(card, environment=replace(card.environment, symmetries=SYMMETRIES)).write(data.path)
    assert CliRunner().invoke(main, ["encode", *arguments]).exit_code == 0
    assert len(list((data.path / "latents").glob("*/train-9x4-*"))) == 8


def test_symmetries_do_not_make_another_dataset_and_are_added_to_old_cards(data, monkeypatch):
    from square_world import Square

    declared = replace(Square.card, symmetries=SYMMETRIES)
    monkeypatch.setattr(Square, "card", declared)
    shard = data.shard_path(0).read_bytes()
    generate("square", data.path, episodes={"train": 3}, workers=0, progress=False)
    again = EpisodeDataset(data.path, "train")
    assert again.card.environment.symmetries == SYMMETRIES
    assert again.shard_path(0).read_bytes() == shard
    assert np.array_equal(again.lengths, data.lengths)
