"""The data module of training: an endless stream of clips, and held-out clips for validation."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.clips import ClipDataset, DataConfig, hold_out, take_fraction
from acwm_core.data.dataset import EpisodeDataset, declared_symmetries
from acwm_core.data.latents import LatentClipDataset, compresses, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler, InOrder
from acwm_core.data.streaming import ClipStream
from acwm_core.errors import AcwmWarning, DataError, TrainingError
from acwm_core.model.codec import Codec

NOT_RESUMABLE = (
    "data.reader=webdataset cannot continue exactly: a resumed run sees the clips in another order "
    "than one that was not interrupted; data.reader=random_access resumes with the very next clip"
)

FEWEST_EPISODES = 30
"""Fewer teach little of what actions do, as measured on three worlds in findings/data-amount.md."""

ROUNDING = 1e-6
"""Share of the largest value of a field by which float32 and a solver move what stands still."""


class ClipData(L.LightningDataModule):
    """Clips of a data folder's `train` split for training and validation.

    Clips are latents, encoded once, if the recipe caches latents and they are smaller than video;
    otherwise they are video. The stream of training clips never ends. Each optimiser step takes the
    next clips of it, however many devices and batches share the step. So a resumed run continues
    with the very next clip, also on other devices.

    Attributes:
        states: fields of the state to learn.
        frames: frames per clip: as many as the recipe says, but no more than the longest episode
            has.

    Args:
        episodes: the split `train`.
        codec: frozen; encodes the clips once if the recipe caches latents.

    Raises:
        DataError: the recipe asks for symmetries that the data does not have, or the card says that
            nothing can be trained on the data.
    """

    def __init__(
        self, config: DataConfig, episodes: EpisodeDataset, codec: Codec, seed: int
    ) -> None:
        super().__init__()
        if reason := episodes.card.source.get("unusable"):
            raise DataError(f"{episodes.path} cannot be trained on: {reason}")
        self.config, self.episodes, self.codec, self.seed = config, episodes, codec, seed
        self.states = config.states
        self._split = self._divided()
        self._symmetries = declared_symmetries(episodes) if config.symmetries else ()
        self._check_states()
        self._check_weights()
        self._once = max(self.episodes.lengths)  # a stride that gives one clip, at the start
        self._streams = config.reader == "webdataset"
        stride = codec.temporal_stride
        whole = 1 + stride * ((self._once - 1) // stride)  # longest episode, in whole latent frames
        self.frames = min(config.clip_frames, max(whole, config.context_frames + stride))
        successive = self.frames - config.context_frames
        self._stride = successive if config.clip_starts == "episode" else config.window_stride
        self._cached = config.cache_latents and compresses(codec) and not self._streams

    def _check_states(self) -> None:
        """Refuse symmetries that do not say how they transform the states to learn."""
        card = self.episodes.card.environment
        for name, symmetry in itertools.product(self.states, self._symmetries):
            if name in card.fields and not card.transforms(symmetry, name):
                raise DataError(
                    f"data.states: the card of {self.episodes.path} does not say how the symmetry "
                    f"{symmetry.name} transforms {name}: leave out {name}, or data.symmetries"
                )

    def _check_weights(self) -> None:
        """Refuse weights of frames that are not there, or are none."""
        name, fields = self.config.weights, self.episodes.card.environment.fields
        if name is None:
            return
        where = f"data.weights={name}: {self.episodes.path}"
        single = [field for field in fields if math.prod(fields[field].shape) == 1]
        if name not in single:
            which = f"those with one are {', '.join(single)}" if single else "none has one"
            raise DataError(f"{where} has no such field of the state with one number: {which}")
        weights = [self.episodes.states(index, [name]) for index in self._split[0]]
        wrong = [not (np.isfinite(rows).all() and (rows >= 0).all()) for rows in weights]
        if any(wrong):
            episode = self._split[0][wrong.index(True)]
            raise DataError(f"{where} has weights in episode {episode} that are not 0 or more")
        if not any(rows.any() for rows in weights):
            raise DataError(f"{where} has no weight above 0, so nothing would be learnt")

    def state_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the states to learn, `[S]` each, over training episodes.

        Of a value that never changes, or by the rounding of its field alone, the deviation is one.
        """
        if not self.states:
            return torch.zeros(0), torch.ones(0)
        scales = [self._scale_of(name) for name in self.states]
        mean, std = (np.concatenate(parts) for parts in zip(*scales, strict=True))
        return torch.tensor(mean, dtype=torch.float32), torch.tensor(std, dtype=torch.float32)

    def _scale_of(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rows = np.concatenate([self.episodes.states(index, [name]) for index in self._split[0]])
        mean, std = rows.mean(0, dtype=np.float64), rows.std(0, dtype=np.float64)
        std[std <= ROUNDING * max(np.abs(mean).max(), std.max())] = 1
        return mean, std

    def _divided(self) -> tuple[Sequence[int], range]:
        """The episodes to train on, and those that are held out."""
        training, validation = hold_out(len(self.episodes), self.config.validation_episodes)
        return take_fraction(training, self.config.fraction), validation

    def sample(self, clips: int) -> tuple[Tensor, Tensor]:
        """First clips of held-out episodes: video `[B, T, 3, H, W]` uint8 and actions.

        They are cut to one length; where lengths differ, longer episodes are preferred. B is 0 if
        nothing is held out.
        """
        held_out = self._split[1]
        if not held_out or not clips:
            return torch.empty(0, 1, 3, 1, 1, dtype=torch.uint8), torch.empty(0, 1, 1)
        starts = self._clips(held_out, self._once, cached=False, per_length=clips)
        first_clips = next(iter(ClipLoader(starts, InOrder(starts.lengths, clips))))
        return first_clips["video"], first_clips["actions"]

    def setup(self, stage: str) -> None:
        """Encode clips that are not encoded yet, each rank a part on its device; open the clips."""
        if len(self._split[0]) < FEWEST_EPISODES and not self.config.growing:
            self._warn_of_few()
        if self._cached:
            self._encode()
        self._train = self._training_clips()
        self._validation = self._clips(self._split[1], self._stride, cached=self._cached)

    def _warn_of_few(self) -> None:
        if not self.trainer or self.is_first_process:
            warnings.warn(
                f"{self.episodes.path} has {len(self._split[0])} episodes to train on: from fewer "
                f"than {FEWEST_EPISODES} a model learns what the scene looks like, but little of "
                "what the actions do",
                AcwmWarning,
                stacklevel=2,
            )

    @property
    def device(self) -> torch.device:
        """The device that trains."""
        return self._trainer().strategy.root_device

    @property
    def is_first_process(self) -> bool:
        """Whether this is the process that reports progress."""
        return self._trainer().is_global_zero

    @property
    def training_clips(self) -> ClipDataset | LatentClipDataset:
        """The clips to train on, once they are open."""
        return self._train

    def _training_clips(self) -> ClipDataset | LatentClipDataset:
        return self._clips(
            self._split[0],
            self._stride,
            cached=self._cached,
            per_length=self.clips_per_step if self.trainer else self.config.batch_size,
            symmetries=self._symmetries,
            weights=self.config.weights,
        )

    def _encode(self) -> None:
        trainer = self._trainer()
        self.codec.to(trainer.strategy.root_device)
        for symmetry in (None, *self._symmetries):
            encode_windows(
                self.episodes,
                self.codec,
                frames=self.frames,
                stride=self._stride,
                symmetry=symmetry,
                progress=trainer.is_global_zero,
            )

    def train_dataloader(self) -> ClipLoader:
        """The stream of clips, starting after those of the steps done so far."""
        trainer, seed = self._trainer(), self.seed
        if self._streams:
            if trainer.is_global_zero:
                warnings.warn(NOT_RESUMABLE, AcwmWarning, stacklevel=2)
            seed += trainer.global_step  # so that a resumed run sees another order
        return self._loader(self._train, seed, trainer.global_step * self.clips_per_step)

    def _loader(
        self, clips: ClipDataset | LatentClipDataset, seed: int, position: int, origin: int = 0
    ) -> ClipLoader:
        """The clips from a position in their stream on, which begins at `origin`."""
        trainer, config = self._trainer(), self.config
        sampler = ClipSampler(
            len(clips),
            batch_size=config.batch_size,
            seed=seed,
            rank=trainer.global_rank,
            world_size=trainer.world_size,
            lengths=clips.lengths,
            accumulated=trainer.accumulate_grad_batches,
            origin=origin,
        )
        sampler.position = position
        streamed = clips
        if self._streams and isinstance(clips, ClipDataset):
            streamed = ClipStream(clips, sampler, shuffle_buffer=config.shuffle_buffer)
        pinned = trainer.strategy.root_device.type not in ("cpu", "mps")
        return ClipLoader(streamed, sampler, workers=config.workers, pin_memory=pinned)

    def val_dataloader(self) -> ClipLoader | list[Any]:
        """The held-out clips in order; every rank uses all, so that all agree on the loss."""
        if not len(self._validation):
            return []
        return ClipLoader(
            self._validation, InOrder(self._validation.lengths, self.config.batch_size)
        )

    def state_dict(self) -> dict[str, Any]:
        """Clips per optimiser step; with the number of steps this gives the place in the stream."""
        return {"clips_per_step": self.clips_per_step}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
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
        self, episodes: Sequence[int], stride: int, *, cached: bool, **of_clips: Any
    ) -> ClipDataset | LatentClipDataset:
        windows: dict[str, Any] = {
            "frames": self.frames,
            "stride": stride,
            "indices": episodes,
            "temporal_stride": self.codec.temporal_stride,
            "given": self.config.context_frames,
            "states": self.states,
            **of_clips,
        }
        if not cached:
            return ClipDataset(self.episodes, **windows)
        return LatentClipDataset(self.episodes, self.codec.latents_fingerprint(), **windows)
