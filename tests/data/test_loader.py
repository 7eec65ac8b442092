"""The order of clips: every clip once per epoch, of all ranks together, and exact resume."""

import itertools
import subprocess
import sys

import numpy as np
import pytest
import torch

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.loader import ClipLoader, ClipSampler, InOrder, epoch_order


class Numbers:
    """Clip i is the number i."""

    def __init__(self, length):
        self.lengths = np.zeros(length)

    def __len__(self):
        return len(self.lengths)

    def batch(self, indices):
        return {"numbers": torch.as_tensor(indices)}


def loader(length=23, batch_size=3, **settings):
    sampler = ClipSampler(length, batch_size=batch_size, seed=5, **settings)
    return ClipLoader(Numbers(length), sampler)


def first(loader, count):
    return [batch["numbers"].tolist() for batch in itertools.islice(loader, count)]


def stream(length, seed, count):
    """The first `count` clips of the endless stream, by its definition."""
    epochs = -(-count // length)
    return np.concatenate([epoch_order(length, seed, epoch) for epoch in range(epochs)])[:count]


def test_epochs_are_different_permutations_that_the_seed_decides():
    orders = [epoch_order(50, seed, epoch) for seed in (0, 1) for epoch in (0, 1)]
    for order in orders:
        assert sorted(order.tolist()) == list(range(50))
    assert len({tuple(order.tolist()) for order in orders}) == 4
    np.testing.assert_array_equal(epoch_order(50, 1, 1), orders[3])


@pytest.mark.parametrize("length", [1, 5, 23, 24])
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_ranks_together_take_every_clip_once_an_epoch(length, ranks):
    steps = -(-4 * length // (3 * ranks))
    taken = [first(loader(length, rank=rank, world_size=ranks), steps) for rank in range(ranks)]
    together = list(itertools.chain(*(b for step in zip(*taken, strict=True) for b in step)))
    assert len(together) >= 4 * length
    np.testing.assert_array_equal(together, stream(length, 5, len(together)))
    for epoch in range(4):
        assert sorted(together[epoch * length : (epoch + 1) * length]) == list(range(length))


def test_resuming_goes_on_exactly_at_any_point():
    whole = first(loader(), 200)
    for killed_after in np.random.default_rng(0).integers(0, 160, 100).tolist():
        killed, second = loader(), loader()
        seen = first(killed, killed_after)
        second.order.position = killed.order.position
        assert seen + first(second, 40) == whole[: killed_after + 40]


def test_resuming_with_other_ranks_or_batches_goes_on_with_the_next_clip():
    killed = loader(batch_size=4)
    seen = first(killed, 4)
    halves = [loader(batch_size=3, rank=rank, world_size=2) for rank in range(2)]
    for each in halves:
        each.order.position = killed.order.position
    taken = [first(each, 8) for each in halves]
    rest = list(itertools.chain(*(b for step in zip(*taken, strict=True) for b in step)))
    together = list(itertools.chain(*seen)) + rest
    np.testing.assert_array_equal(together, stream(23, 5, len(together)))


def test_batches_of_workers_are_those_of_this_process(square_data):
    """Those they fetch ahead do not count as used."""
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    loaders = [ClipLoader(clips, ClipSampler(len(clips), batch_size=3), workers=n) for n in (0, 2)]
    alone, shared = ([*itertools.islice(loader, 30)] for loader in loaders)
    assert [loader.order.position for loader in loaders] == [90, 90]
    for one, other in zip(alone, shared, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.parametrize("ranks", [1, 2])
def test_positions_are_the_places_in_the_stream(ranks):
    """Noise is drawn by them: each clip that is taken has its own, on any number of ranks."""
    loaders = [loader(rank=rank, world_size=ranks) for rank in range(ranks)]
    steps = zip(*(itertools.islice(each, 20) for each in loaders), strict=True)
    batches = [batch for step in steps for batch in step]
    positions = [place for batch in batches for place in batch["positions"]]
    assert positions == [*range(60 * ranks)]
    numbers = [number for batch in batches for number in batch["numbers"].tolist()]
    np.testing.assert_array_equal(numbers, stream(23, 5, 60 * ranks))


def test_in_order_every_clip_comes_once_longest_first():
    clips = Numbers(5)
    clips.lengths = np.array([5, 9, 5, 9, 9])
    batches = [*ClipLoader(clips, InOrder(clips.lengths, 2))]
    assert [batch["numbers"].tolist() for batch in batches] == [[1, 3], [4], [0, 2]]
    assert [batch["positions"] for batch in batches] == [(1, 3), (4,), (0, 2)]


def test_nothing_to_sample_is_refused():
    with pytest.raises(ValueError, match="no clips"):
        ClipSampler(0, batch_size=2)


FULL = """
import torch
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.errors import DataError


class Clips:
    def batch(self, indices):
        return {"video": torch.zeros(len(indices), 512, 1024, dtype=torch.uint8)}


if __name__ == "__main__":
    try:
        for _ in zip(range(20), ClipLoader(Clips(), ClipSampler(8, batch_size=4), workers=2)):
            pass
    except DataError as error:
        print(error)
"""


@pytest.mark.ci
def test_full_shared_memory_is_one_sentence_and_no_hang(tmp_path):
    """With that of a container, in a mount namespace of its own."""
    script = tmp_path / "full.py"
    script.write_text(FULL)
    mount = "mount -t tmpfs -o size=4m tmpfs /dev/shm"
    if subprocess.run(["unshare", "-m", "sh", "-c", mount], capture_output=True).returncode:
        pytest.skip("mounts need privileges")
    command = f"{mount} && exec {sys.executable} {script}"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", command], capture_output=True, text=True, timeout=100
    )
    assert "/dev/shm of 4 MB" in done.stdout, done.stderr
    assert "--shm-size" in done.stdout
    assert "data.workers=0" in done.stdout
