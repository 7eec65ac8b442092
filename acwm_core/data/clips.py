"""Which clips training takes and in what order: the recipe's section `data`, windows, the sampler.

It does not import torch, so that recipes are checked quickly.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError, RecipeError


@dataclass(frozen=True)
class DataConfig:
    """The recipe's section `data`: which clips training sees, and how they are loaded.

    Attributes:
        path: the data folder that `acwm generate` made, or its URL.
        batch_size: clips per batch on each device.
        clip_frames: frames per clip, at most the frames of a whole episode.
        context_frames: how many first frames of a clip are given, in training and in rollouts: 1,
            or 1 plus a multiple of the codec's temporal stride. A single frame shows no velocity.
        clip_starts: `anywhere` takes a clip every `window_stride` frames of an episode. `episode`
            takes the one at its first frame, where simulated scenes are at rest; in episodes long
            enough for another whole clip, that begins with the last `context_frames` frames of
            the clip before.
        window_stride: frames between the starts of an episode's clips, for `clip_starts=anywhere`.
            A larger stride gives fewer clips, whose latents take less disk space and encoding.
        fraction: share of the training episodes to train on, in (0, 1]. The choice is always the
            same, and a larger fraction contains all episodes of a smaller one.
        validation_episodes: episodes held out from the end of `train` for the validation loss; a
            tenth by default, at most 32.
        cache_latents: encode every clip once with the frozen codec and train on the cache, if
            latents are smaller than frames; otherwise decode and encode video at every step.
        workers: processes that load batches in the background; 0 loads in the training process.
        reader: `random_access` reads shards on the local disk, shuffles all clips and resumes
            exactly; `webdataset` streams the shards, so a dataset may be larger than the disk.
        shuffle_buffer: size of the buffer, in clips, from which each process of the `webdataset`
            reader draws the next clip.
        skip_damaged: if a shard is damaged, warn, replace its clips by other clips (always the
            same ones) and go on. By default training stops and names the shard.
    """

    path: str
    batch_size: int = 16
    clip_frames: int = 37
    context_frames: int = 1
    clip_starts: Literal["anywhere", "episode"] = "anywhere"
    window_stride: int = 4
    fraction: float = 1.0
    validation_episodes: int | None = None
    cache_latents: bool = True
    workers: int = 0
    reader: Literal["random_access", "webdataset"] = "random_access"
    shuffle_buffer: int = 2000
    skip_damaged: bool = False

    def __post_init__(self) -> None:
        minima = {"batch_size": 1, "clip_frames": 2, "window_stride": 1, "workers": 0}
        minima |= {"shuffle_buffer": 1, "validation_episodes": 0, "context_frames": 1}
        for name, minimum in minima.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise RecipeError(f"data.{name}={value} must be at least {minimum}")
        if not 0 < self.fraction <= 1:
            raise RecipeError(f"data.fraction={self.fraction} must be above 0 and at most 1")


def window_starts(length: int, frames: int, stride: int) -> range:
    """First frames of the windows of an episode of `length` frames.

    Windows lie inside the episode. An episode shorter than a window gives one window, from frame 0.
    """
    return range(0, max(1, length - frames + 1), stride)


def list_windows(
    lengths: Sequence[int], frames: int, stride: int, episodes: Sequence[int] | None = None
) -> NDArray[np.int64]:
    """The windows of episodes with these `lengths`, as rows ``(episode, first frame)``, `[N, 2]`.

    Args:
        lengths: frames of each episode.
        frames: frames of a window.
        stride: frames between the starts of an episode's windows.
        episodes: the episodes to use; all by default.
    """
    chosen = range(len(lengths)) if episodes is None else episodes
    rows = [(e, start) for e in chosen for start in window_starts(lengths[e], frames, stride)]
    return np.array(rows, np.int64).reshape(-1, 2)


def clip_lengths(
    windows: NDArray[np.int64],
    lengths: Sequence[int],
    frames: int,
    temporal_stride: int | None,
    given: int = 1,
    per_length: int = 1,
) -> NDArray[np.int64]:
    """Number of frames of each clip, `[N]`; episodes shorter than a window give shorter clips.

    Such a clip is cut to whole latent frames of `temporal_stride` video frames. It keeps at least
    the `given` video frames to start from and one latent frame to predict; only an episode too
    short for that is padded, by repeating its last frame. If `temporal_stride` is None, all clips
    have `frames` frames. See `shared_lengths` for `per_length`.
    """
    if temporal_stride is None:
        return np.full(len(windows), frames)
    held = np.asarray(lengths, np.int64)[windows[:, 0]] - windows[:, 1]
    least = 1 + (given - 1) // temporal_stride
    latent_steps = np.maximum(least, (held - 1) // temporal_stride)
    whole = np.where(held < frames, np.minimum(frames, 1 + temporal_stride * latent_steps), frames)
    return shared_lengths(whole, per_length)


def shared_lengths(lengths: NDArray[np.int64], clips: int) -> NDArray[np.int64]:
    """Shorten clips of lengths `[N]` until at least `clips` of them share each length.

    A batch holds clips of one length, so those of a rare length would fill it with copies. Clips
    join the next shorter ones, but none loses more than a quarter of its frames. So a rare length
    may remain, if no others are near it.
    """
    shared, values = lengths.copy(), np.unique(lengths)[::-1]
    first = 0  # longest length of the group
    for place, value in enumerate(values):
        group = (lengths <= values[first]) & (lengths >= value)
        is_last = place + 1 == len(values) or values[place + 1] < 0.75 * values[first]
        if is_last or group.sum() >= clips:
            shared[group] = value
            first = place + 1
    return shared


def common_length(lengths: NDArray[np.int64], indices: Sequence[int]) -> int:
    """The number of frames that the clips `indices` all have.

    Raises:
        ValueError: their lengths differ, so they cannot form a batch.
    """
    found = lengths[np.asarray(indices)]
    if (found != found[0]).any():
        raise ValueError(f"a batch cannot hold clips of {sorted(set(found.tolist()))} frames")
    return int(found[0])


def hold_out(episodes: int, validation: int | None) -> tuple[range, range]:
    """Split episodes ``0 … episodes − 1`` into those to train on and the last ones, held out.

    By default a tenth is held out, at least one and at most 32.

    Raises:
        DataError: nothing would be left to train on.
    """
    if validation is None:
        validation = min(32, max(1, episodes // 10), episodes - 1)
    if validation >= episodes:
        raise DataError(
            f"data.validation_episodes={validation} leaves nothing of {episodes} episodes to "
            "train on: hold out fewer or generate more"
        )
    return range(episodes - validation), range(episodes - validation, episodes)


def take_fraction(episodes: Sequence[int], fraction: float) -> Sequence[int]:
    """A fixed subset of `episodes`, in order: at least one, and nested for growing `fraction`.

    A fixed permutation selects them, independent of the training seed, because neighbouring
    episodes in a dataset may be alike.
    """
    if fraction == 1:
        return episodes
    count = max(1, round(fraction * len(episodes)))
    order = np.random.Generator(np.random.Philox(0)).permutation(len(episodes))
    places: list[int] = np.sort(order[:count]).tolist()
    return [episodes[place] for place in places]


def padded_video(video: NDArray[np.uint8], frames: int) -> NDArray[np.uint8]:
    """`video` ``[T, …]``, padded to `frames` frames by repeating its last frame."""
    missing = frames - len(video)
    return np.concatenate([video, video[-1:].repeat(missing, 0)]) if missing > 0 else video


def window_actions(actions: NDArray[np.float32], start: int, frames: int) -> NDArray[np.float32]:
    """The actions `[frames, A]` of a window; the last row is zero, as it would lead out of it."""
    window = np.zeros((frames, actions.shape[1]), np.float32)
    inside = actions[start : start + frames - 1]
    window[: len(inside)] = inside
    return window


def epoch_order(length: int, seed: int, epoch: int, stream: int = 0) -> NDArray[np.int64]:
    """The order of clips in epoch `epoch` of a stream: a permutation of ``0 … length − 1``."""
    key = np.random.SeedSequence([seed, epoch, stream] if stream else [seed, epoch])
    return np.random.Generator(np.random.Philox(key)).permutation(length)


class ClipSampler:
    """A batch sampler over an endless stream of epochs, each a permutation of all clips.

    A step of W ranks takes the next W·B clips, a batch of B per rank. A batch cannot hold clips of
    different lengths, so each length has its own stream. The streams take turns, evenly spread and
    in proportion to their clips; all clips of a step come from one stream.

    Args:
        length: number of clips.
        batch_size: clips per batch of one rank.
        seed: seed of the order; the same on every rank.
        rank: index of this process, 0 … world_size − 1.
        world_size: number of processes that train together.
        lengths: length of each clip; the longest form stream 0. All equal by default.
        accumulated: batches per rank and optimiser step, all of one length.

    Attributes:
        position: number of clips that all ranks together have taken; an iteration starts there.
            An iteration does not change it: the consumer sets it, as only the consumer knows
            which prefetched clips were used.
    """

    def __init__(
        self,
        length: int,
        *,
        batch_size: int,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
        lengths: Sequence[int] | NDArray[np.int64] | None = None,
        accumulated: int = 1,
    ) -> None:
        if length < 1:
            raise ValueError("there are no clips to sample from")
        self.batch_size, self.seed = batch_size, seed
        self.rank, self.world_size = rank, world_size
        self.position = 0
        self._step = accumulated * self.clips_per_step
        of_clips = np.zeros(length) if lengths is None else np.asarray(lengths)
        self._streams = [np.flatnonzero(of_clips == one) for one in np.unique(of_clips)[::-1]]
        self._orders: dict[int, tuple[int, NDArray[np.int64]]] = {}
        counts = [len(members) for members in self._streams]
        when = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
        whose = np.repeat(np.arange(len(counts)), counts)
        self._turns = whose[np.argsort(when, kind="stable")]  # stream of each step in one cycle
        self._visits = np.zeros(length, np.int64)  # earlier turns of its stream in the cycle
        for stream, count in enumerate(counts):
            self._visits[self._turns == stream] = np.arange(count)

    @property
    def clips_per_step(self) -> int:
        """Clips that all ranks together take per step, one batch each."""
        return self.batch_size * self.world_size

    def __iter__(self) -> Iterator[list[int]]:
        start = self.position
        if len(self._streams) > 1:  # round down, in case the size of a step has changed
            start -= start % self.clips_per_step
        first = start + self.rank * self.batch_size
        for place in itertools.count(first, self.clips_per_step):
            step, offset = divmod(place, self._step)
            cycle, turn = divmod(step, len(self._turns))
            stream = int(self._turns[turn])
            visit = cycle * len(self._streams[stream]) + int(self._visits[turn])
            yield self._taken(stream, visit * self._step + offset)

    def _taken(self, stream: int, start: int) -> list[int]:
        """A batch of clips of one stream, from position `start` in that stream on."""
        members, taken = self._streams[stream], list[int]()
        epoch, offset = divmod(start, len(members))
        while len(taken) < self.batch_size:
            if self._orders.get(stream, (-1,))[0] != epoch:  # cached for this epoch
                order = epoch_order(len(members), self.seed, epoch, stream)
                self._orders[stream] = epoch, order
            order = self._orders[stream][1]
            taken += members[order[offset:][: self.batch_size - len(taken)]].tolist()
            epoch, offset = epoch + 1, 0
        return taken
