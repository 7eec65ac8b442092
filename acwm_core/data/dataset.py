"""`ClipDataset`: clips of fixed length from episodes, as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import torch
from torch import Tensor
from torch.utils.data import Dataset

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.windows import list_windows, padded_video, window_actions

__all__ = ["ClipDataset", "EpisodeDataset", "VideoClip"]


class VideoClip(TypedDict):
    """A clip: `video` uint8 ``[T, 3, H, W]``, `actions` float32 ``[T, A]`` with a zero last row."""

    video: Tensor
    actions: Tensor


class ClipDataset(Dataset[VideoClip]):
    """The windows of a split's episodes.

    Args:
        episodes: where the clips come from.
        frames: frames of a clip, T; a shorter episode gives one clip that repeats its last frame
            with zero actions.
        stride: frames between the starts of an episode's clips.
        indices: only these episodes, e.g. those of `hold_out`; all by default.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
    ) -> None:
        self.episodes, self.frames = episodes, frames
        self.windows = list_windows(episodes.lengths, frames, stride, indices)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> VideoClip:
        """Decode one clip.

        Raises:
            DataError: its shard is missing or damaged.
        """
        episode, start = map(int, self.windows[index])
        stop = min(start + self.frames, self.episodes.lengths[episode])
        video = padded_video(self.episodes.video(episode, start, stop), self.frames)
        actions = window_actions(self.episodes.actions(episode), start, self.frames)
        return {"video": torch.as_tensor(video), "actions": torch.as_tensor(actions)}
