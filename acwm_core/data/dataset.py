"""`ClipDataset`: clips of episodes, as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.windows import clip_lengths, common_length, list_windows, window_actions

__all__ = ["ClipDataset", "EpisodeDataset", "VideoClip"]


MOST_ACTIONS = 2**14
"""Episodes whose actions a process keeps."""


class VideoClip(TypedDict):
    """A clip: `video` uint8 ``[T, 3, H, W]``, `actions` float32 ``[T, A]`` with a zero last row."""

    video: Tensor
    actions: Tensor


class ClipDataset(Dataset[VideoClip]):
    """The windows of a split's episodes.

    Args:
        episodes: where the clips come from.
        frames: frames of a clip, T; a shorter episode gives one clip.
        stride: frames between the starts of an episode's clips.
        indices: only these episodes, e.g. those of `hold_out`; all by default.
        temporal_stride: the codec's; clips of shorter episodes then are as long as whole latent
            frames of it allow. By default they repeat their last frame with zero actions.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip.
        lengths: frames of each clip; see `clip_lengths`.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
        temporal_stride: int | None = None,
    ) -> None:
        self.episodes, self.frames = episodes, frames
        self.windows = list_windows(episodes.lengths, frames, stride, indices)
        self.lengths = clip_lengths(self.windows, episodes.lengths, frames, temporal_stride)
        self._actions: dict[int, NDArray[np.float32]] = {}

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> VideoClip:
        """Decode one clip.

        Raises:
            DataError: its shard is missing or damaged.
        """
        batch = self.batch([index])
        return {"video": batch["video"][0], "actions": batch["actions"][0]}

    def batch(self, indices: Sequence[int], into: VideoClip | None = None) -> VideoClip:
        """Decode clips straight into one batch, ``[B, T, 3, H, W]`` and ``[B, T, A]``.

        Args:
            indices: which clips, all of one length.
            into: a batch of as many clips to overwrite, instead of a new one.

        Raises:
            DataError: a shard is missing or damaged.
        """
        frames = common_length(self.lengths, indices)
        batch = into or self._empty(len(indices), frames)
        video: NDArray[np.uint8] = batch["video"].numpy()
        actions: NDArray[np.float32] = batch["actions"].numpy()
        windows: list[tuple[int, int]] = self.windows[list(indices)].tolist()
        for row, (episode, start) in enumerate(windows):
            held = min(frames, self.episodes.lengths[episode] - start)
            self.episodes.video_into(video[row, :held], episode, start)
            video[row, held:] = video[row, held - 1]
            actions[row] = window_actions(self._actions_of(episode), start, frames)
        return batch

    def _actions_of(self, episode: int) -> NDArray[np.float32]:
        """Those of lately used episodes are kept: they are small, and many clips share them."""
        if episode not in self._actions:
            if len(self._actions) == MOST_ACTIONS:
                self._actions.clear()
            self._actions[episode] = self.episodes.actions(episode)
        return self._actions[episode]

    def _empty(self, clips: int, frames: int) -> VideoClip:
        card = self.episodes.card.environment
        video = torch.empty(clips, frames, 3, *card.frame_size, dtype=torch.uint8)
        return {"video": video, "actions": torch.empty(clips, frames, card.action.size)}
