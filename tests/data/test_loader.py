"""The order of clips: every clip once per epoch, equal steps on every rank, exact resume."""

import itertools

import numpy as np
import pytest
import torch
from lightning.fabric.utilities.types import _Stateful

from acwm_core.data.clips import ClipSampler, epoch_order
from acwm_core.data.episodes import ClipDataset, EpisodeDataset
from acwm_core.data.loader import ResumableLoader


class Numbers:
    """Clip i is the number i."""

    def __init__(self, length):
        self.lengths = np.zeros(length)

    def __len__(self):
        return len(self.lengths)

    def batch(self, indices):
        return torch.as_tensor(indices)


def loader(length=23, batch_size=3, **settings):
    return ResumableLoader(Numbers(length), batch_size=batch_size, seed=5, **settings)


def passes(loader, count):
    return [batch.tolist() for _ in range(count) for batch in loader]


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
def test_ranks_take_equal_steps_and_together_every_clip_once_an_epoch(length, ranks):
    loaders = [loader(length, rank=rank, world_size=ranks) for rank in range(ranks)]
    assert len({len(each) for each in loaders}) == 1
    taken = [passes(each, 4) for each in loaders]
    assert {len(batches) for batches in taken} == {4 * len(loaders[0])}
    together = list(itertools.chain(*(b for step in zip(*taken, strict=True) for b in step)))
    assert len(together) >= 4 * length
    np.testing.assert_array_equal(together, stream(length, 5, len(together)))
    for epoch in range(4):
        assert sorted(together[epoch * length : (epoch + 1) * length]) == list(range(length))


def test_resuming_goes_on_exactly_at_any_point():
    whole = passes(loader(), 40)
    rng = np.random.default_rng(0)
    for _ in range(100):
        killed_after = int(rng.integers(0, 160))
        first = loader()
        seen = []
        while len(seen) < killed_after:
            seen += [b.tolist() for b in itertools.islice(first, killed_after - len(seen))]
        second = loader()
        second.load_state_dict(first.state_dict())
        rest = passes(second, 5)
        assert seen + rest == whole[: len(seen) + len(rest)]
        # The pass that was interrupted is finished first, so that epochs stay where they were.
        ended = (len(first) - killed_after % len(first)) % len(first) or len(first)
        assert len(rest) == ended + 4 * len(first)


def test_resuming_with_other_ranks_or_batches_goes_on_with_the_next_clip():
    first = loader(batch_size=4)
    seen = [b.tolist() for b in itertools.islice(first, 4)]
    state = first.state_dict()
    halves = [loader(batch_size=3, rank=rank, world_size=2) for rank in range(2)]
    for each in halves:
        each.load_state_dict(state)
    taken = [passes(each, 2) for each in halves]
    rest = list(itertools.chain(*(b for step in zip(*taken, strict=True) for b in step)))
    together = list(itertools.chain(*seen)) + rest
    np.testing.assert_array_equal(together, stream(23, 5, len(together)))


def test_lightning_takes_it_for_stateful():
    assert isinstance(loader(), _Stateful)


def test_batches_fetched_ahead_are_not_counted_as_used(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    settings = {"batch_size": 4, "seed": 1}
    whole = [batch["video"] for batch in ResumableLoader(clips, **settings)]
    first = ResumableLoader(clips, workers=1, **settings)
    seen = [batch["video"] for batch in itertools.islice(first, 3)]
    assert first.state_dict()["position"] == 12
    second = ResumableLoader(clips, **settings)
    second.load_state_dict(first.state_dict())
    rest = [batch["video"] for batch in second]
    assert len(seen + rest) == len(whole)
    for one, other in zip(seen + rest, whole, strict=True):
        np.testing.assert_array_equal(one, other)


def test_batches_of_workers_are_those_of_this_process(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    loaders = [ResumableLoader(clips, batch_size=3, seed=2, workers=n) for n in (0, 2)]
    alone, shared = ([*loader, *loader] for loader in loaders)
    assert len(alone) == len(shared) == 30
    for one, other in zip(alone, shared, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_nothing_to_sample_is_refused():
    with pytest.raises(ValueError, match="no clips"):
        ClipSampler(0, batch_size=2)
