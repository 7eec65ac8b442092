"""Encoding by processes that share the work and are killed; `acwm encode` and its mistakes."""

import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from blocks import Blocks
from click.testing import CliRunner
from conftest import PATIENCE, checksums, wait_until
from encoding_slowly import FRAMES

from acwm_core.cli import main
from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import CARD, LatentClipDataset, encode_windows
from acwm_core.errors import DataError

HERE = Path(__file__).parent


@pytest.fixture
def many_shards(tmp_path):
    folder = tmp_path / "data"
    generate("square", folder, episodes={"train": 12}, workers=0, shard_episodes=2, progress=False)
    return folder


def start(data, log, free):
    """A process that encodes so many episodes, and is then in the midst of another."""
    return subprocess.Popen(
        [sys.executable, str(HERE / "encoding_slowly.py"), str(data), str(log), str(free)],
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        text=True,
    )


@pytest.mark.ci
def test_two_processes_divide_the_shards_and_one_finishes_what_a_killed_one_began(
    many_shards, tmp_path
):
    """No shard is made twice, but the one that the killed process was at; the bytes are one's."""
    whole = tmp_path / "whole"
    shutil.copytree(many_shards, whole)
    folder = encode_windows(
        EpisodeDataset(whole, "train"), Blocks(remembers=True), frames=FRAMES, progress=False
    )
    log = tmp_path / "log"
    both = [start(many_shards, log, free=3) for _ in range(2)]  # each is in its second shard
    made = many_shards / folder.relative_to(whole)
    wait_until(lambda: log.exists() and len(log.read_text().split()) == 8)
    both[0].send_signal(signal.SIGKILL)
    both[0].communicate(timeout=PATIENCE)
    finished = {path.name: path.stat().st_ino for path in made.glob("*.npy")}
    assert len(finished) == 2
    both[1].communicate("\n", timeout=PATIENCE)
    assert both[1].returncode == 0
    assert not list(made.glob(".*.partial"))
    assert finished.items() <= {p.name: p.stat().st_ino for p in made.glob("*.npy")}.items()
    hidden = {name for name in checksums(made) if name.startswith(".")}
    assert {n: c for n, c in checksums(made).items() if n not in hidden} == {
        n: c for n, c in checksums(folder).items() if not n.startswith(".")
    }
    episodes = Counter(map(int, log.read_text().split()))
    assert episodes == {both[0].pid: 4, both[1].pid: 12 - 2}


def test_a_folder_that_was_renamed_is_not_misread(many_shards):
    """Latents of a codec stay that codec's, whatever their folder is called."""
    episodes = EpisodeDataset(many_shards, "train")
    folder = encode_windows(episodes, Blocks(), frames=9, progress=False)
    other = Blocks(gain=2.0).fingerprint()
    folder.parent.rename(folder.parent.with_name(other))
    with pytest.raises(
        DataError, match=r"other latents than its name says, .* 'blocks-4-False-1\.0'"
    ):
        LatentClipDataset(episodes, other, frames=9)
    with pytest.raises(DataError, match="delete the folder and encode again"):
        encode_windows(episodes, Blocks(gain=2.0), frames=9, progress=False)
    (folder.parent.with_name(other) / folder.name / CARD).write_text("{")
    with pytest.raises(DataError, match="delete the folder"):
        LatentClipDataset(episodes, other, frames=9)


@pytest.mark.parametrize("harm", ["cut", "other shape", "other type", "pickle"])
def test_damaged_latents_are_named(many_shards, harm):
    episodes = EpisodeDataset(many_shards, "train")
    folder = encode_windows(episodes, Blocks(), frames=9, progress=False)
    file = folder / "shard-00001.npy"
    array = np.load(file)
    if harm == "cut":
        file.write_bytes(file.read_bytes()[:-10])
    elif harm == "pickle":
        np.save(file, np.array([print], object), allow_pickle=True)
    else:
        np.save(file, array[:-1] if harm == "other shape" else array.astype(np.float32))
    latents = LatentClipDataset(episodes, Blocks().fingerprint(), frames=9)
    place = int(np.flatnonzero(latents.windows[:, 0] == 2)[0])
    with pytest.raises(DataError, match=r"shard-00001\.npy are damaged .*encode again"):
        latents[place]


def test_batches_are_the_clips(many_shards):
    episodes = EpisodeDataset(many_shards, "train")
    encode_windows(episodes, Blocks(), frames=25, stride=3, progress=False)  # longer than episodes
    latents = LatentClipDataset(episodes, Blocks().fingerprint(), frames=25, stride=3)
    clips = ClipDataset(episodes, frames=25, stride=3)
    chosen = [7, 0, 11, 7]
    batch = latents.batch(chosen)
    for row, index in enumerate(chosen):
        np.testing.assert_array_equal(batch["latents"][row], latents[index]["latents"])
        np.testing.assert_array_equal(batch["actions"][row], clips[index]["actions"])


def run(*words):
    return CliRunner().invoke(main, ["encode", *map(str, words)])


def test_the_command_encodes_once(many_shards):
    done = run(many_shards, "--codec", "compact", "--frames", 9, "--split", "train")
    assert done.exit_code == 0, done.output
    (file, *_) = sorted(many_shards.glob("latents/*/train-9x4-*/*.npy"))
    made = file.stat().st_mtime_ns
    again = run(many_shards, "--codec", "compact", "--frames", 9, "--split", "all")
    assert again.exit_code == 0, again.output
    assert file.stat().st_mtime_ns == made
    other = run(many_shards, "--codec", "compact", "codec.weights=random", "--frames", 9)
    assert other.exit_code == 0, other.output
    assert len(list((many_shards / "latents").iterdir())) == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--codec", "compct"], "did you mean 'compact'"),
        (["--codec", "compact", "codec.wights=1"], "no parameter 'wights'"),
        (["--codec", "compact", "weights=random"], "write codec.NAME=VALUE"),
        (["--codec", "compact", "--split", "tran"], "no split 'tran', only train"),
        (
            ["--codec", "compact", "--device", "nowhere"],
            "--device nowhere: this machine has no such",
        ),
    ],
)
def test_mistakes_are_one_sentence(many_shards, words, sentence):
    done = run(many_shards, *words)
    assert done.exit_code == 2
    assert sentence in done.output
    assert done.output.count("\n") == 1
    assert not (many_shards / "latents").exists()
