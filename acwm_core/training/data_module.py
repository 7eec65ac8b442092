"""The data module of training: an endless stream of clips, and the clips held out from it."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from acwm_core.codec import Codec
from acwm_core.data.config import DataConfig
from acwm_core.data.dataset import ClipDataset, EpisodeDataset
from acwm_core.data.encoding import encode_windows
from acwm_core.data.fetching import Fetching, Replacements, SizedDataset, as_fetched
from acwm_core.data.latents import LatentClipDataset, compresses
from acwm_core.data.loader import ResumableLoader
from acwm_core.data.windows import hold_out
from acwm_core.errors import DataError


class ClipData(L.LightningDataModule):
    """Clips of a data folder's `train` split for training and validation.

    Clips come as latents, encoded once, if the recipe says so and latents are smaller than video;
    else as video. The training clips have no end, so that the position in them is one number that
    a checkpoint keeps: a resumed run goes on with the very next clip.

    Args:
        config: the recipe's section `data`.
        codec: frozen; encodes the clips once if the recipe caches latents.
        seed: of the order of clips.

    Raises:
        DataError: no such data, or the data is unfinished or damaged.
    """

    def __init__(self, config: DataConfig, codec: Codec, seed: int) -> None:
        super().__init__()
        self.config, self.codec, self.seed = config, codec, seed
        self.episodes = EpisodeDataset(config.path, "train")
        self._parts = hold_out(len(self.episodes), config.validation_episodes)
        self._cached = config.cache_latents and compresses(codec)
        self._first = self._batches_before = 0  # where in the stream this process began

    @property
    def fps(self) -> int:
        """Frames per second of the clips."""
        return self.episodes.card.environment.fps

    def sample(self, clips: int) -> tuple[Tensor, Tensor]:
        """The start of the first held-out episodes: video `[B, T, 3, H, W]` uint8 and actions.

        B is 0 if nothing is held out.
        """
        episodes = self._parts[1][:clips]
        if not episodes:
            return torch.empty(0, 1, 3, 1, 1, dtype=torch.uint8), torch.empty(0, 1, 1)
        once = max(self.episodes.lengths)  # a stride that leaves one clip per episode
        starts = ClipDataset(
            self.episodes, frames=self.config.clip_frames, stride=once, indices=episodes
        )
        (shown,) = InOrder(starts, len(starts), self.config.skip_damaged)
        return shown["video"], shown["actions"]

    def setup(self, stage: str) -> None:
        """Encode what is not encoded yet, each rank a part of it on its device; open the clips."""
        if self._cached:
            trainer = self._trainer()
            self.codec.to(trainer.strategy.root_device)
            encode_windows(
                self.episodes,
                self.codec,
                frames=self.config.clip_frames,
                stride=self.config.window_stride,
                skip_damaged=self.config.skip_damaged,
                progress=trainer.is_global_zero,
            )
        make = self._latents if self._cached else self._videos
        self._train, self._validation = (make(episodes) for episodes in self._parts)

    def train_dataloader(self) -> Endless:
        """The stream from where the checkpoint left it."""
        trainer = self._trainer()
        loader = ResumableLoader(
            self._train,
            batch_size=self.config.batch_size,
            seed=self.seed,
            rank=trainer.global_rank,
            world_size=trainer.world_size,
            workers=self.config.workers,
            pin_memory=trainer.strategy.root_device.type == "cuda",
            skip_damaged=self.config.skip_damaged,
        )
        loader.sampler.position = self._first
        return Endless(loader, trainer.global_rank)

    def val_dataloader(self) -> InOrder | list[Any]:
        """The held-out clips in order; every rank takes all, so that all agree on the loss."""
        if not len(self._validation):
            return []
        return InOrder(self._validation, self.config.batch_size, self.config.skip_damaged)

    def state_dict(self) -> dict[str, int]:
        """Where training is: clips of the stream used by all ranks together, batches per rank."""
        batches = self._trainer().fit_loop.total_batch_idx + 1
        clips = self._clips_per_step()
        position = self._first + (batches - self._batches_before) * clips
        return {"position": position, "batches": batches, "clips_per_step": clips}

    def load_state_dict(self, state_dict: Mapping[str, int]) -> None:
        """Go on with the next clip; say so if steps are of another size now."""
        self._first, self._batches_before = state_dict["position"], state_dict["batches"]
        now = self._clips_per_step()
        before = state_dict.get("clips_per_step", now)  # older checkpoints don't say
        if before != now:
            rank_zero_warn(
                f"a step took {before} clips of all ranks when this run stopped and takes {now} "
                "now: training goes on with the very next clip, but not on the same loss curve"
            )

    def _clips_per_step(self) -> int:
        return self.config.batch_size * self._trainer().world_size

    def _trainer(self) -> L.Trainer:
        assert self.trainer is not None
        return self.trainer

    def _videos(self, episodes: range) -> ClipDataset:
        frames, stride = self.config.clip_frames, self.config.window_stride
        return ClipDataset(self.episodes, frames=frames, stride=stride, indices=episodes)

    def _latents(self, episodes: range) -> LatentClipDataset:
        frames, stride = self.config.clip_frames, self.config.window_stride
        name = self.codec.fingerprint()
        return LatentClipDataset(
            self.episodes,
            name,
            frames=frames,
            stride=stride,
            indices=episodes,
            skip_damaged=self.config.skip_damaged,
        )


class Endless:
    """The batches of a loader, pass after pass."""

    def __init__(self, loader: ResumableLoader[Any], rank: int) -> None:
        self._loader, self._rank = loader, rank

    def __iter__(self) -> Iterator[Any]:
        """Batches without end.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped.
        """
        try:
            while True:
                yield from self._loader
        except DataError as error:
            # The first process tells the user what ends all; this ends one, and it does not know.
            if self._rank:
                sys.stderr.write(f"acwm: {error}\n")
            raise


class InOrder:
    """The clips of a dataset in order, in batches of which the last may be smaller."""

    def __init__(self, clips: SizedDataset[Any], batch_size: int, skip_damaged: bool) -> None:
        fetching = cast(Dataset[Any], Fetching(clips, skip_damaged=skip_damaged))
        self._loader = DataLoader(fetching, batch_size, collate_fn=cast(Any, as_fetched))
        self._replaced = Replacements()

    def __len__(self) -> int:
        """Batches."""
        return len(self._loader)

    def __iter__(self) -> Iterator[Any]:
        """The batches.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped.
        """
        return map(self._replaced.batch_of, self._loader)
