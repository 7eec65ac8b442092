"""The order of clips: every clip once per epoch, equal steps on every rank, exact resume."""

import itertools

import numpy as np
import pytest
import torch
from lightning.fabric.utilities.types import _Stateful

from acwm_core.data.dataset import ClipDataset, EpisodeDataset
from acwm_core.data.loader import ResumableLoader
from acwm_core.data.sampler import ClipSampler, epoch_order
from acwm_core.data.slots import SLOTS, Inbox, Outbox


class Numbers:
    """Item i is i."""

    def __init__(self, length):
        self.length = length

    def __len__(self):
        return self.length

    def __getitem__(self, index):
        return index


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


def test_batches_of_workers_stay_what_they_are(square_data):
    """Workers write into the same memory again and again; what was handed out is not touched."""
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    loaders = [ResumableLoader(clips, batch_size=3, seed=2, workers=n) for n in (0, 2)]
    alone, shared = ([*loader, *loader, *loader] for loader in loaders)
    assert len(alone) == len(shared) == 45  # each of six slots many times
    for one, other in zip(alone, shared, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_a_slot_is_sent_once_and_then_named(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    outbox, inbox = Outbox(), Inbox()
    for start in range(2 * SLOTS):
        sent = outbox.fill(clips, range(start, start + 2), worker=4)
        assert (sent.number, sent.slot is None) == (0, start > 0)
        received = inbox.batch(sent)
        np.testing.assert_array_equal(received["video"], clips.batch([start, start + 1])["video"])
        del received


def test_a_slot_is_free_when_its_last_view_is_gone(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    outbox, inbox = Outbox(), Inbox()
    received = inbox.batch(outbox.fill(clips, [0, 1], worker=0))
    frame = received["video"][1, 2].numpy()
    del received
    kept = frame.copy()
    other = inbox.batch(outbox.fill(clips, [4, 5], worker=0))
    np.testing.assert_array_equal(frame, kept)
    del frame
    assert outbox.fill(clips, [6, 7], worker=0).number == 0
    np.testing.assert_array_equal(other["video"], clips.batch([4, 5])["video"])


def test_who_keeps_every_batch_gets_memory_of_its_own(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4)
    outbox, inbox = Outbox(), Inbox()
    batches = [range(n, n + 2) for n in range(2 * SLOTS)]
    sent = [outbox.fill(clips, batch, worker=4) for batch in batches]
    assert [each.number for each in sent] == [*range(SLOTS), *[None] * SLOTS]
    assert all(each.slot.tensors["video"].is_shared() for each in sent)
    for each, batch in zip([inbox.batch(each) for each in sent], batches, strict=True):
        np.testing.assert_array_equal(each["video"], clips.batch(batch)["video"])
    smaller = outbox.fill(clips, [7], worker=4)
    np.testing.assert_array_equal(inbox.batch(smaller)["video"], clips.batch([7])["video"])


def test_a_slot_may_hold_bfloat16():
    class Ones:
        def batch(self, indices, into=None):
            batch = into or {"latents": torch.empty(len(indices), 3, dtype=torch.bfloat16)}
            batch["latents"].fill_(1)
            return batch

    batch = Inbox().batch(Outbox().fill(Ones(), [1, 2], worker=0))
    assert torch.equal(batch["latents"], torch.ones(2, 3, dtype=torch.bfloat16))


def test_nothing_to_sample_is_refused():
    with pytest.raises(ValueError, match="no clips"):
        ClipSampler(0, batch_size=2)
