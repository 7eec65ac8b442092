"""`ClipDataset`: clips of fixed length from episodes, as tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch.utils.data import Dataset, get_worker_info

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.windows import list_windows, window_actions

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
        batch = self.batch([index])
        return {"video": batch["video"][0], "actions": batch["actions"][0]}

    def batch(self, indices: Sequence[int]) -> VideoClip:
        """Decode clips straight into one batch, ``[B, T, 3, H, W]`` and ``[B, T, A]``.

        Raises:
            DataError: a shard is missing or damaged.
        """
        card = self.episodes.card.environment
        video = _to_send((len(indices), self.frames, 3, *card.frame_size), torch.uint8)
        actions = _to_send((len(indices), self.frames, card.action.size), torch.float32)
        for row, index in enumerate(indices):
            episode, start = map(int, self.windows[index])
            held = min(self.frames, self.episodes.lengths[episode] - start)
            self.episodes.video_into(video[row, :held].numpy(), episode, start)
            video[row, held:] = video[row, held - 1]
            whole = self.episodes.actions(episode)
            actions[row] = torch.as_tensor(window_actions(whole, start, self.frames))
        return {"video": video, "actions": actions}


def _to_send(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """A tensor to fill; in a worker it lies where the training process reads it without a copy."""
    if get_worker_info() is None:
        return torch.empty(shape, dtype=dtype)
    # As PyTorch's own default_collate does; share_memory_() would copy what is not filled yet.
    storage: Any = torch.UntypedStorage._new_shared(math.prod(shape) * dtype.itemsize)  # pyright: ignore
    return torch.empty(0, dtype=dtype).set_(storage).view(shape)
