"""Parameters of the data that training reads, free of torch so that recipes are checked quickly."""

from __future__ import annotations

from dataclasses import dataclass

from acwm_core.errors import RecipeError


@dataclass(frozen=True)
class DataConfig:
    """The recipe's section `data`: which clips training sees, and how they are loaded.

    Attributes:
        path: the data folder that `acwm generate` made, or its URL.
        batch_size: clips per batch on each device.
        clip_frames: frames of a clip.
        window_stride: frames between the starts of an episode's clips; with cached latents fewer
            clips take less disk and encoding.
        fraction: of the training episodes to train on, in (0, 1]: always the same ones, and those
            of a smaller fraction are among those of a larger one.
        validation_episodes: episodes held out from the end of `train` for the validation loss; a
            tenth by default, at most 32.
        cache_latents: encode every clip once with the frozen codec and train on the cache, if
            latents are smaller than frames; otherwise decode and encode video at every step.
        workers: processes that load batches in the background; 0 loads in the training process.
        skip_damaged: train on, with a warning, if a shard is damaged; other clips take the place of
            its own, always the same ones. By default training ends with the name of the shard.
    """

    path: str
    batch_size: int = 16
    clip_frames: int = 37
    window_stride: int = 4
    fraction: float = 1.0
    validation_episodes: int | None = None
    cache_latents: bool = True
    workers: int = 0
    skip_damaged: bool = False

    def __post_init__(self) -> None:
        self._require("batch_size", 1)
        self._require("clip_frames", 2)
        self._require("window_stride", 1)
        if self.validation_episodes is not None:
            self._require("validation_episodes", 0)
        self._require("workers", 0)
        if not 0 < self.fraction <= 1:
            raise RecipeError(f"data.fraction={self.fraction} must be above 0 and at most 1")

    def _require(self, name: str, least: int) -> None:
        if getattr(self, name) < least:
            raise RecipeError(f"data.{name}={getattr(self, name)} must be at least {least}")
