"""Which clips training takes: the recipe's section `data`, the windows of episodes, `ClipDataset`.

It does not import torch, so that recipes are checked quickly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from acwm_core.errors import DataError, RecipeError
from acwm_core.recipe.types import NonNegativeInt, PositiveInt

if TYPE_CHECKING:
    from torch import Tensor

    from acwm_core.data.dataset import EpisodeDataset
    from acwm_core.env.card import EnvironmentCard
    from acwm_core.env.symmetry import Symmetry

_Floats = NDArray[np.float32]


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
        states: fields of the state that the model learns to predict too, so that it knows where the
            agent is: what a robot knows of itself, e.g. ``[joint_position]``. Rollouts are given
            none. By default those that the model chooses.
        weights: field of the state with one number per frame, 0 or more: how much the loss of what
            the action of that frame leads to counts, e.g. ``action_confidence`` of episodes that
            `acwm data label` wrote. By default all count alike; validation always does.
        symmetries: train on each clip also as the symmetries on the card of the data transform it:
            push_cube, which has seven, gives eight times as many clips. Validation does not.
        growing: train on the episodes that a running `acwm generate` has finished, and look for
            more after each pass. The first ones are held out, not the last.
        cache_latents: encode every clip once with the frozen codec and train on the cache, if
            latents are smaller than frames; otherwise decode and encode video at every step.
        workers: processes that load batches in the background; 0 loads in the training process.
        reader: `random_access` reads shards on the local disk, shuffles all clips and resumes
            exactly; `webdataset` streams the shards, so a dataset may be larger than the disk.
        shuffle_buffer: size of the buffer, in clips, from which each process of the `webdataset`
            reader draws the next clip.
    """

    path: str
    batch_size: PositiveInt = 16
    clip_frames: Annotated[int, Ge(2)] = 37
    context_frames: PositiveInt = 1
    clip_starts: Literal["anywhere", "episode"] = "anywhere"
    window_stride: PositiveInt = 4
    fraction: Annotated[float, Gt(0), Le(1)] = 1.0
    validation_episodes: NonNegativeInt | None = None
    states: tuple[str, ...] = ()
    weights: str | None = None
    symmetries: bool = False
    growing: bool = False
    cache_latents: bool = True
    workers: NonNegativeInt = 0
    reader: Literal["random_access", "webdataset"] = "random_access"
    shuffle_buffer: PositiveInt = 2000

    def __post_init__(self) -> None:
        if self.states and self.reader != "random_access":
            raise RecipeError("data.states needs data.reader=random_access")
        if self.weights and self.reader != "random_access":
            raise RecipeError("data.weights needs data.reader=random_access")
        if self.growing and (self.fraction != 1 or self.reader != "random_access"):
            raise RecipeError(
                "data.growing uses all episodes and needs data.reader=random_access: "
                "omit data.fraction and data.reader, or data.growing"
            )


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
    chosen = lengths[np.asarray(indices)]
    if (chosen != chosen[0]).any():
        raise ValueError(f"a batch cannot hold clips of {sorted(set(chosen.tolist()))} frames")
    return int(chosen[0])


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
    episodes in a dataset may be similar.
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


def window_states(states: NDArray[np.float32], start: int, frames: int) -> NDArray[np.float32]:
    """The rows `[frames, …]` of a window; after the end of the episode, its last one."""
    window = states[start : start + frames]
    return np.concatenate([window, window[-1:].repeat(frames - len(window), 0)])


class Clips(ABC):
    """The windows of a split's episodes as a map-style dataset of clips.

    Args:
        episodes: where the clips come from.
        frames: frames of a clip, T; a shorter episode gives one clip.
        stride: frames between the starts of an episode's clips.
        indices: only these episodes, e.g. those of `hold_out`; all by default.
        temporal_stride: temporal stride of the codec. Clips of shorter episodes are then cut to
            whole latent frames; by default they repeat their last frame with zero actions.
        given: context frames of a clip; every clip has at least one latent frame more to predict.
        per_length: how many clips should share a length, as those of a batch do; see
            `shared_lengths`.
        symmetries: of the environment; each window gives one more clip by each of them.
        states: names of fields of the state; batches then hold them.
        weights: name of the field of the state with the weights of frames; batches then hold them.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip.
        lengths: number of video frames of each clip; see `clip_lengths` and `shared_lengths`.
        versions: those of every window, in turn: as recorded (None), and by each symmetry.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
        temporal_stride: int | None = None,
        given: int = 1,
        per_length: int = 1,
        symmetries: Sequence[Symmetry] = (),
        states: Sequence[str] = (),
        weights: str | None = None,
    ) -> None:
        self.episodes, self.frames, self.stride = episodes, frames, stride
        self._fields, self._weights = tuple(states), weights
        self.versions: tuple[Symmetry | None, ...] = (None, *symmetries)
        windows = list_windows(episodes.lengths, frames, stride, indices)
        self.windows = windows.repeat(len(self.versions), axis=0)
        self.lengths = clip_lengths(
            self.windows, episodes.lengths, frames, temporal_stride, given, per_length
        )
        # Actions, fields of the state and weights of recently used episodes.
        self._read: dict[int, tuple[_Floats, list[_Floats], _Floats | None]] = {}

    def __len__(self) -> int:
        return len(self.windows)

    def version(self, index: int) -> Symmetry | None:
        """The symmetry by which a clip is transformed; None if it is as recorded."""
        return self.versions[index % len(self.versions)]

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """One clip: the arrays of `batch` without the batch axis."""
        return {name: values[0] for name, values in self.batch([index]).items()}

    def batch(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Read clips of one length as a batch, which is faster than one by one.

        Returns:
            The frames, see the class; ``actions`` float32 ``[B, T, A]``, last rows zero; and
            ``states`` float32 ``[B, T, S]`` and ``weights`` ``[B, T]``, if they were asked for.

        Raises:
            DataError: a shard is missing or damaged.
        """
        frames = common_length(self.lengths, indices)
        return {**self._frames(indices, frames), **self.inputs(indices)}

    def inputs(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """What `batch` returns beside the frames."""
        import torch

        frames = common_length(self.lengths, indices)
        rows = [self._inputs(int(index), frames) for index in indices]
        return {name: torch.as_tensor(np.stack([r[name] for r in rows])) for name in rows[0]}

    @abstractmethod
    def _frames(self, indices: Sequence[int], frames: int) -> dict[str, Tensor]:
        """What shows the first `frames` frames of some clips."""

    def _remember(self, episode: int) -> None:
        """Read the actions, states and weights of an episode."""
        fields = [self.episodes.states(episode, [name]) for name in self._fields]
        weights = self.episodes.states(episode, [self._weights])[:, 0] if self._weights else None
        self._read[episode] = self.episodes.actions(episode), fields, weights

    def _inputs(self, index: int, frames: int) -> dict[str, NDArray[np.float32]]:
        """Actions, states and weights of a clip."""
        episode, start = map(int, self.windows[index])
        symmetry = self.version(index)
        if episode not in self._read:
            if len(self._read) == 2**14:  # a limit for memory; they are small
                self._read.clear()
            self._remember(episode)
        actions, fields, weights = self._read[episode]
        rows = {"actions": window_actions(actions, start, frames)}
        if symmetry:
            rows["actions"] = symmetry.of_actions(rows["actions"])
            card = self.episodes.card.environment
            pairs = zip(self._fields, fields, strict=True)
            fields = [_transformed(card, symmetry, *pair) for pair in pairs]
        if fields:
            rows["states"] = window_states(np.concatenate(fields, 1), start, frames)
        if weights is not None:
            rows["weights"] = window_states(weights, start, frames)
        return rows


def _transformed(
    card: EnvironmentCard, symmetry: Symmetry, name: str, values: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The values ``[T, S]`` of a field of the state, its axes side by side, after a symmetry."""
    apart = values.reshape(len(values), *card.fields[name].shape)
    return card.transformed(symmetry, name, apart).reshape(values.shape)


class ClipDataset(Clips):
    """Clips as video, ``video`` uint8 ``[B, T, 3, H, W]``."""

    def _frames(self, indices: Sequence[int], frames: int) -> dict[str, Tensor]:
        import torch

        size = self.episodes.card.environment.frame_size
        video = np.empty((len(indices), frames, 3, *size), np.uint8)
        windows: list[tuple[int, int]] = self.windows[list(indices)].tolist()
        for row, (episode, start) in enumerate(windows):
            self.episodes.video_into(video[row], episode, start)
            if symmetry := self.version(indices[row]):
                video[row] = symmetry.of_frames(video[row]).copy()
        return {"video": torch.as_tensor(video)}
