"""The data module of training: an endless stream of clips, and held-out clips for validation."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from acwm_core.data.clips import DataConfig, hold_out, take_fraction
from acwm_core.data.encoding import encode_windows
from acwm_core.data.episodes import ClipDataset, Clips, EpisodeDataset
from acwm_core.data.latents import LatentClipDataset, compresses
from acwm_core.data.loader import Fetching, Replacements, ResumableLoader
from acwm_core.data.streaming_reader import StreamingLoader
from acwm_core.errors import AcwmWarning, DataError, TrainingError
from acwm_core.model.codec import Codec

NOT_RESUMABLE = (
    "data.reader=webdataset cannot continue exactly: a resumed run sees the clips in another order "
    "than one that was not interrupted; data.reader=random_access resumes with the very next clip"
)


class ClipData(L.LightningDataModule):
    """Clips of a data folder's `train` split for training and validation.

    Clips are latents, encoded once, if the recipe caches latents and they are smaller than video;
    otherwise they are video. The stream of training clips never ends. Each optimiser step takes the
    next clips of it, however many devices and batches share the step. So a resumed run continues
    with the very next clip, also on other devices.

    Attributes:
        frames: frames per clip: as many as the recipe says, but no more than the longest episode
            has.

    Args:
        codec: frozen; encodes the clips once if the recipe caches latents.
    """

    def __init__(
        self, config: DataConfig, episodes: EpisodeDataset, codec: Codec, seed: int
    ) -> None:
        super().__init__()
        self.config, self.episodes, self.codec, self.seed = config, episodes, codec, seed
        training, validation = hold_out(len(self.episodes), config.validation_episodes)
        self._split = take_fraction(training, config.fraction), validation
        self._once = max(self.episodes.lengths)  # a stride that gives one clip, at the start
        self._streams = config.reader == "webdataset"
        stride = codec.temporal_stride
        whole = 1 + stride * ((self._once - 1) // stride)  # longest episode, in whole latent frames
        self.frames = min(config.clip_frames, max(whole, config.context_frames + stride))
        successive = self.frames - config.context_frames
        self._stride = successive if config.clip_starts == "episode" else config.window_stride
        self._cached = config.cache_latents and compresses(codec) and not self._streams

    def sample(self, clips: int) -> tuple[Tensor, Tensor]:
        """First clips of held-out episodes: video `[B, T, 3, H, W]` uint8 and actions.

        They are cut to one length; where lengths differ, longer episodes are preferred. B is 0 if
        nothing is held out.
        """
        held_out = self._split[1]
        if not held_out or not clips:
            return torch.empty(0, 1, 3, 1, 1, dtype=torch.uint8), torch.empty(0, 1, 1)
        starts = self._clips(held_out, self._once, cached=False, per_length=clips)
        shown = next(iter(InOrder(starts, clips, self.config.skip_damaged)))
        return shown["video"], shown["actions"]

    def setup(self, stage: str) -> None:
        """Encode clips that are not encoded yet, each rank a part on its device; open the clips."""
        if self._cached:
            trainer = self._trainer()
            self.codec.to(trainer.strategy.root_device)
            encode_windows(
                self.episodes,
                self.codec,
                frames=self.frames,
                stride=self._stride,
                skip_damaged=self.config.skip_damaged,
                progress=trainer.is_global_zero,
            )
        training, validation = self._split
        count = self.clips_per_step if self.trainer else self.config.batch_size
        self._train = self._clips(training, self._stride, cached=self._cached, per_length=count)
        self._validation = self._clips(validation, self._stride, cached=self._cached)

    def train_dataloader(self) -> Endless:
        """The stream of clips, starting after those of the steps done so far."""
        trainer = self._trainer()
        settings: dict[str, Any] = {
            "batch_size": self.config.batch_size,
            "rank": trainer.global_rank,
            "world_size": trainer.world_size,
            "workers": self.config.workers,
            "pin_memory": trainer.strategy.root_device.type == "cuda",
            "skip_damaged": self.config.skip_damaged,
        }
        if self._streams:
            if trainer.is_global_zero:
                warnings.warn(NOT_RESUMABLE, AcwmWarning, stacklevel=2)
            loader = StreamingLoader(
                cast(ClipDataset, self._train),
                seed=self.seed + trainer.global_step,  # so that a resumed run sees another order
                shuffle_buffer=self.config.shuffle_buffer,
                **settings,
            )
        else:
            accumulated = trainer.accumulate_grad_batches
            loader = ResumableLoader(
                self._train, seed=self.seed, accumulated=accumulated, **settings
            )
        loader.sampler.position = trainer.global_step * self.clips_per_step
        return Endless(loader)

    def val_dataloader(self) -> InOrder | list[Any]:
        """The held-out clips in order; every rank uses all, so that all agree on the loss."""
        if not len(self._validation):
            return []
        return InOrder(self._validation, self.config.batch_size, self.config.skip_damaged)

    def state_dict(self) -> dict[str, int]:
        """Clips per optimiser step; with the number of steps this gives the place in the stream."""
        return {"clips_per_step": self.clips_per_step}

    def load_state_dict(self, state_dict: Mapping[str, int]) -> None:
        """Check that training can resume with the next clip, also on other devices.

        Raises:
            TrainingError: an optimiser step takes a different number of clips than before.
        """
        before, trainer = state_dict["clips_per_step"], self._trainer()
        if before != self.clips_per_step:
            raise TrainingError(
                f"a step of this run takes {before} clips, but {trainer.world_size} device(s) with "
                f"data.batch_size={self.config.batch_size} and trainer.accumulate_grad_batches="
                f"{trainer.accumulate_grad_batches} make {self.clips_per_step}: choose three whose "
                f"product is {before}"
            )

    @property
    def clips_per_step(self) -> int:
        """Clips per optimiser step, of all devices together."""
        trainer = self._trainer()
        return self.config.batch_size * trainer.world_size * trainer.accumulate_grad_batches

    def _trainer(self) -> L.Trainer:
        assert self.trainer is not None
        return self.trainer

    def _clips(
        self, episodes: Sequence[int], stride: int, *, cached: bool, per_length: int = 1
    ) -> ClipDataset | LatentClipDataset:
        windows: dict[str, Any] = {
            "frames": self.frames,
            "stride": stride,
            "indices": episodes,
            "temporal_stride": self.codec.temporal_stride,
            "given": self.config.context_frames,
            "per_length": per_length,
        }
        if not cached:
            return ClipDataset(self.episodes, **windows)
        skip_damaged, name = self.config.skip_damaged, self.codec.fingerprint()
        return LatentClipDataset(self.episodes, name, skip_damaged=skip_damaged, **windows)


class Endless:
    """The batches of a loader, with ``"positions"``: the places of their clips in the stream."""

    def __init__(self, loader: ResumableLoader | StreamingLoader) -> None:
        self._loader = loader

    def __iter__(self) -> Iterator[Any]:
        """Batches without end.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped.
        """
        sampler = self._loader.sampler
        try:
            for batch in self._loader:  # the loader has already moved to the next step's position
                start = sampler.position - sampler.clips_per_step
                start += sampler.rank * sampler.batch_size
                positions = tuple(range(start, start + sampler.batch_size))
                yield {**batch, "positions": positions}
        except DataError as error:
            # Only the first process reports errors, but it does not know of this one: print here.
            if sampler.rank:
                sys.stderr.write(f"acwm: {error}\n")
            raise


class InOrder:
    """The clips of a dataset in order, longest first.

    Each batch holds clips of one length; the last batch of a length may be smaller.
    """

    def __init__(self, clips: Clips, batch_size: int, skip_damaged: bool) -> None:
        lengths = clips.lengths
        groups = [np.flatnonzero(lengths == length) for length in np.unique(lengths)[::-1]]
        self._batches: list[list[int]] = [
            group[start : start + batch_size].tolist()
            for group in groups
            for start in range(0, len(group), batch_size)
        ]
        self._loader = DataLoader(
            Fetching(clips, skip_damaged=skip_damaged), batch_size=None, sampler=self._batches
        )
        self._replaced = Replacements()

    def __len__(self) -> int:
        """The number of batches."""
        return len(self._loader)

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the batches, with ``"positions"``: the places of their clips in the dataset.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped.
        """
        for places, fetched in zip(self._batches, self._loader, strict=True):
            yield {**self._replaced.batch_of(fetched), "positions": tuple(places)}
