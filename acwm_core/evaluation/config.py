"""Parameters of evaluation, free of torch so that recipes are checked in no time."""

from __future__ import annotations

from dataclasses import dataclass

from acwm_core.episode import SPLITS
from acwm_core.errors import RecipeError, suggest


@dataclass(frozen=True)
class EvaluationConfig:
    """The recipe's section `evaluation`: which clips are predicted and what is measured.

    Attributes:
        metrics: registered names; `psnr`, or else the first, ranks the episodes.
        frames: length of each clip, from frame 0 of its episode; None takes whole episodes.
        steps: sampling steps; None takes the flow's own.
        steps_sweep: numbers of sampling steps at which a few clips are predicted as well, for the
            curve of the scores against steps; none for no curve.
        sweep_episodes: how many clips of each split these are, the first ones.
        batch_size: clips predicted at once; changes speed and memory, not the results.
        seed: of the sampling noise and of which other episode's actions a clip is shown.
        splits: the test splits, in the order of the report; None takes those that the data has.
        episodes: the first so many of each split; None takes them all.
        videos: videos of the best, the median and the worst episodes, so many of each per split.
        device: where the model runs, e.g. ``"cpu"`` or ``"cuda:1"``; ``"auto"`` takes a GPU if
            there is one.
    """

    metrics: tuple[str, ...] = ("mse", "m_mse", "ssim", "psnr")
    frames: int | None = 37
    steps: int | None = None
    steps_sweep: tuple[int, ...] = (1, 2, 4, 5, 10, 20, 50)
    sweep_episodes: int = 4
    batch_size: int = 8
    seed: int = 0
    splits: tuple[str, ...] | None = None
    episodes: int | None = None
    videos: int = 1
    device: str = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "metrics", tuple(self.metrics))  # YAML has lists only
        object.__setattr__(self, "steps_sweep", tuple(sorted({*self.steps_sweep})))
        self._require("metrics", bool(self.metrics), "must name at least one")
        if self.splits is not None:
            object.__setattr__(self, "splits", tuple(self.splits))
            self._require("splits", bool(self.splits), "must name at least one")
        for split in self.splits or ():
            if split not in SPLITS:
                raise RecipeError(f"evaluation.splits: unknown {split!r}{suggest(split, SPLITS)}")
        self._require("frames", self.frames is None or self.frames >= 2, "must be at least 2")
        self._require("steps", self.steps is None or self.steps >= 1, "must be at least 1")
        self._require("steps_sweep", min(self.steps_sweep, default=1) >= 1, "must be at least 1")
        self._require("sweep_episodes", self.sweep_episodes >= 2, "must be at least 2")
        self._require("batch_size", self.batch_size >= 1, "must be at least 1")
        self._require("seed", self.seed >= 0, "must not be negative")
        self._require("episodes", self.episodes is None or self.episodes >= 2, "must be at least 2")
        self._require("videos", self.videos >= 0, "must not be negative")

    @property
    def headline(self) -> str:
        """The metric that ranks episodes and heads the report."""
        return "psnr" if "psnr" in self.metrics else self.metrics[0]

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise RecipeError(f"evaluation.{name}={getattr(self, name)} {what}")
