"""Ranks and workers in real processes, changed between kills; and how well clips are shuffled."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import test_loader
import torch.multiprocessing
from reading import CLIPS, clips_of, fingerprints, rank_main

from acwm_core.data.loader import epoch_order

SCRIPT = Path(__file__).with_name("reading.py")


def stream(data, count):
    """Checksums of the first `count` clips of the endless stream, by its definition."""
    clips = clips_of(data)
    known = fingerprints(clips.batch(range(len(clips))))
    assert len(set(known)) == len(clips) == 44
    return [known[clip] for clip in test_loader.stream(len(clips), 7, count)]


@pytest.mark.parametrize(
    ("ranks", "workers"),
    [(2, 0), *(pytest.param(*more, marks=pytest.mark.slow) for more in [(2, 2), (4, 0)])],
)
@pytest.mark.ci
def test_ranks_take_equal_steps_whatever_the_shards(ranks, workers, square_data, tmp_path):
    """Three shards on 2 ranks × 2 workers, and more ranks than shards.

    A collective in each step would never end if one rank had fewer.
    """
    assert len(list(square_data.glob("train/*.tar"))) == 3
    arguments = (ranks, workers, str(square_data), str(tmp_path))
    torch.multiprocessing.spawn(rank_main, arguments, nprocs=ranks)
    seen = [json.loads(path.read_text()) for path in sorted(tmp_path.glob("rank-*"))]
    assert len(seen) == ranks
    assert all(each == seen[0] for each in seen)
    together = [clip for step in seen[0] for rank in step for clip in rank]
    assert len(together) == 2 * CLIPS
    assert together == stream(square_data, len(together))
    for epoch in range(len(together) // 44):
        assert len(set(together[epoch * 44 : (epoch + 1) * 44])) == 44


def kill_readers(data, folder, kills, plans):
    command = [sys.executable, str(SCRIPT), str(data), str(folder), "0", str(kills)]
    done = subprocess.run(
        [*command, json.dumps(plans)], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["died"] == kills
    assert said["last"] == 0
    return [Path(folder, str(number)) for number in range(said["runs"])]


def assert_as_if_nothing_had_happened(runs, data):
    """What a run logged at each place of the stream is what belongs there, and no place is missing.

    A reader that was killed after its last saved position reads those clips again; they must be
    the same.
    """
    truth = stream(data, CLIPS + 20)
    for run in runs:
        logged = [line.split() for line in (run / "log").read_text().splitlines()]
        places = {int(place) for place, _ in logged}
        assert places == set(range(max(places) + 1))
        assert max(places) + 1 >= CLIPS
        assert [int(clip) for _, clip in logged] == [truth[int(place)] for place, _ in logged]


@pytest.mark.ci
@pytest.mark.parametrize("kills", [5, pytest.param(100, marks=pytest.mark.slow)])
def test_kills_change_nothing(kills, square_data, tmp_path):
    """Each reader has other ranks, another batch size or workers than the one before."""
    plans = [[1, 3, 0], [2, 2, 0], [1, 4, 2], [3, 1, 0], [1, 8, 0]]
    runs = kill_readers(square_data, tmp_path, kills, plans)
    assert_as_if_nothing_had_happened(runs, square_data)


def neighbours(order, shards):
    """How often two clips in a row are of one shard."""
    shard = order // (len(order) // shards)
    return float((shard[1:] == shard[:-1]).mean())


def unevenness(order, shards, parts=10):
    """Chi-squared of the shards' shares in each tenth of an epoch, per degree of freedom."""
    shard = (order // (len(order) // shards)).reshape(parts, -1)
    counts = np.array([(shard == number).sum(1) for number in range(shards)])
    expected = shard.shape[1] / shards
    return ((counts - expected) ** 2 / expected).sum() / ((shards - 1) * (parts - 1))


def streamed(order_of_shards, rng, length, shards, buffer=64):
    """What a streaming loader with a shuffle buffer makes of it, for comparison."""
    each = length // shards
    source = iter(np.concatenate([np.arange(each) + shard * each for shard in order_of_shards]))
    held = [next(source) for _ in range(buffer)]
    for clip in source:
        place = rng.integers(buffer)
        yield held[place]
        held[place] = clip
    yield from rng.permutation(held)


def test_few_shards_are_shuffled_as_well_as_many():
    """Three shards of 200 clips: the order is as even as a uniform permutation's.

    The same measures find a shuffle buffer of 64 clips out.
    """
    length, shards, epochs = 600, 3, 200
    orders = [epoch_order(length, 3, epoch) for epoch in range(epochs)]
    together = np.array([neighbours(order, shards) for order in orders])
    uniform = (length // shards - 1) / (length - 1)
    assert abs(together.mean() - uniform) < 4 * together.std() / np.sqrt(epochs)
    uneven = np.array([unevenness(order, shards) for order in orders])
    # Shares drawn without replacement: chi-squared per degree of freedom has the mean N / (N - 1).
    assert abs(uneven.mean() - length / (length - 1)) < 4 * uneven.std() / np.sqrt(epochs)
    rng = np.random.default_rng(0)
    buffered = np.array([*streamed(rng.permutation(shards), rng, length, shards)])
    assert sorted(buffered) == list(range(length))
    assert neighbours(buffered, shards) > uniform + 0.2
    assert unevenness(buffered, shards) > 5
