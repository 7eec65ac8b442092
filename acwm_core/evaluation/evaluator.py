"""`Evaluator`: predicts clips batch by batch, scores them, and films some of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.environment import EnvironmentCard
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import (
    KINDS,
    Batch,
    ClipPlan,
    Kind,
    batches,
    load_sample,
    predictors,
)
from acwm_core.evaluation.results import ClipResult, VideoRecord, finite
from acwm_core.evaluation.scoring import Prediction, score
from acwm_core.evaluation.videos import pick_episodes, side_by_side
from acwm_core.metric import Metric
from acwm_core.world_model import CLIP_FRAMES, WorldModel

Advance = Callable[[int], None]
"""Told how many clips more were predicted and scored, in one row each."""

Video = tuple[VideoRecord, NDArray[np.uint8]]
"""A record and its frames `[T, H, W, 3]`."""


@dataclass(frozen=True)
class Evaluator:
    """Everything that scoring takes.

    Attributes:
        world_model: in evaluation mode, on the device where it is to run.
        card: the environment's card, for the metrics.
        metrics: by registered name.
        config: settings.
        window: frames that the model predicts at once.
    """

    world_model: WorldModel
    card: EnvironmentCard
    metrics: Mapping[str, Metric]
    config: EvaluationConfig
    window: int = CLIP_FRAMES

    def scores(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, advance: Advance | None = None
    ) -> list[ClipResult]:
        """All rows of all clips of a split, clip by clip."""
        return self._scored(self._predictions(plans, episodes, KINDS), advance)

    def sweep(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, advance: Advance | None = None
    ) -> dict[int, list[ClipResult]]:
        """The model's row of the first few clips, by each number of steps in `steps_sweep`."""
        few = plans[: self.config.sweep_episodes]
        return {
            steps: self._scored(self._predictions(few, episodes, ("model",), steps), advance)
            for steps in self.config.steps_sweep
        }

    def rows(self, clips: int) -> int:
        """How many rows `scores` and `sweep` predict for so many clips of a split."""
        few = min(clips, self.config.sweep_episodes)
        return len(KINDS) * clips + len(self.config.steps_sweep) * few

    def videos(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, results: Sequence[ClipResult]
    ) -> list[Video]:
        """Videos of the best, median and worst episodes, the median's with other actions too.

        Predicts them once more, with the same noise, so that not all have to be kept.

        Args:
            plans: of the split.
            episodes: of the split.
            results: what `scores` returned for them.
        """
        headline = self.config.headline
        picks = pick_episodes(results, headline, self.metrics[headline], self.config.videos)
        by_episode = {plan.episode: plan for plan in plans}
        values = {(r.episode, r.kind): r.values for r in results}
        videos: list[Video] = []
        for episode, pick in picks.items():
            kinds: tuple[Kind, ...] = ("model", "shuffled") if pick == "median" else ("model",)
            for made in self._predictions([by_episode[episode]], episodes, kinds):
                for each in made:
                    record = _record(each, pick, values[episode, each.kind])
                    videos.append((record, side_by_side(each.sample.video, each.video)))
        return videos

    def _scored(
        self, predictions: Iterator[list[Prediction]], advance: Advance | None
    ) -> list[ClipResult]:
        results: list[ClipResult] = []
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # numpy lets go of the GIL
            for made in predictions:
                jobs = [pool.submit(score, each, self.metrics, self.card) for each in made]
                results.extend(job.result() for job in jobs)
                if advance:
                    advance(len(made))
        return results

    def _predictions(
        self,
        plans: Sequence[ClipPlan],
        episodes: EpisodeDataset,
        kinds: Sequence[Kind],
        steps: int | None = None,
    ) -> Iterator[list[Prediction]]:
        """All rows of a batch of clips at a time; the config's steps unless others are given."""
        config = self.config
        makers = predictors(self.world_model, steps=steps or config.steps, window=self.window)
        device = self.world_model.action_low.device
        samples = (load_sample(plan, episodes, config.frames) for plan in plans)
        for group in batches(samples, config.batch_size):
            batch = Batch.of(group, device)
            with torch.inference_mode(), torch.autocast(device.type, enabled=False):
                made = {kind: makers[kind](batch).float().cpu() for kind in kinds}
            yield [Prediction(s, k, made[k][i]) for i, s in enumerate(group) for k in kinds]


def _record(prediction: Prediction, pick: str, values: Mapping[str, float]) -> VideoRecord:
    sample, kind, plan = prediction.sample, prediction.kind, prediction.sample.plan
    shown = sample.donor_actions if kind == "shuffled" else sample.actions
    return VideoRecord(
        file=f"{plan.split}-{plan.episode:06d}-{kind}.mp4",
        split=plan.split,
        episode=plan.episode,
        ood_label=sample.episode.ood_label,
        pick=pick,
        kind=kind,
        values={name: finite(value) for name, value in values.items()},
        actions=shown.tolist(),
    )
