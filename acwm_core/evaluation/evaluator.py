"""`Evaluator`: predicts clips batch by batch, scores them, and makes videos of a few."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import noting
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.clips import PREDICTORS, Batch, ClipPlan, Predictor, batches, load_samples
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Metric
from acwm_core.evaluation.results import VideoRecord
from acwm_core.evaluation.scoring import (
    Prediction,
    headline_of,
    needs_estimator,
    predictors_for,
    quick_metrics,
    score,
)
from acwm_core.evaluation.statistics import finite
from acwm_core.evaluation.videos import case_study
from acwm_core.model.shapes import Actions, Video
from acwm_core.model.world_model import WorldModel

Results = Mapping[str, list[ClipResult]]
"""Results by split."""

StepsSweep = Mapping[int, list[ClipResult]]
"""Results of the row ``model`` by number of sampling steps."""

ShownClip = tuple[VideoRecord, NDArray[np.uint8]]
"""A record and its frames `[T, H, W, 3]`."""


@dataclass(frozen=True)
class Evaluator:
    """Everything needed to predict and score clips.

    Attributes:
        world_model: in evaluation mode, on the device where it will run.
        card: the environment's card, for the metrics.
        metrics: the metrics by name.
        config: the settings.
        estimator: reads states from video for the metrics; None if there is none.
        left_out: metrics that cannot be measured here, and why.
        advance: progress callback, called with the number of newly scored predictions.
    """

    world_model: WorldModel
    card: EnvironmentCard
    metrics: Mapping[str, Metric]
    config: EvaluationConfig
    estimator: StateEstimator | None = None
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    advance: Callable[[int], None] = lambda count: None

    @property
    def headline(self) -> str:
        """The metric that ranks clips and heads the report."""
        return headline_of(self.metrics)

    @property
    def predictors(self) -> tuple[Predictor, ...]:
        """The rows that `scores` predicts; ``truth`` only if a metric reads states from video."""
        reads = any(needs_estimator(metric, self.card) for metric in self.metrics.values())
        return tuple(each for each in PREDICTORS if reads or each != "truth")

    @property
    def given(self) -> int:
        """How many context frames of a clip the model is given."""
        return self.config.context_frames or self.world_model.context_frames

    @property
    def steps_sweep(self) -> tuple[int, ...]:
        """Numbers of sampling steps to compare; empty for a model without sampling steps."""
        return self.config.steps_sweep if self.world_model.objective.steps else ()

    @property
    def device(self) -> torch.device:
        """The device on which the model runs."""
        return self.world_model.action_low.device

    def predict(self, batch: Batch, predictors: Sequence[Predictor]) -> dict[Predictor, Video]:
        """The predictions of these rows, each `[B, T, 3, H, W]` float32 on the CPU."""

        def rollout(actions: Actions) -> Video:
            chunks = self.world_model.rollout_chunks(
                batch.video[:, : batch.given],
                actions,
                mode=self.config.mode,
                steps=self.config.steps,
                seeds=batch.seeds,
            )
            return torch.cat([*chunks], 1)

        functions: dict[Predictor, Callable[[], Video]] = {
            "model": lambda: rollout(batch.actions),
            "shuffled": lambda: rollout(batch.donor_actions),
            "copy": lambda: batch.video[:, batch.given - 1, None].expand_as(batch.video),
            "codec": lambda: self.world_model.codec(batch.video),
            "truth": lambda: batch.video,
        }
        with torch.inference_mode(), torch.autocast(self.device.type, enabled=False):
            return {each: functions[each]().float().cpu() for each in predictors}

    def scores(
        self,
        plans: Sequence[ClipPlan],
        episodes: EpisodeDataset,
        predictors: Sequence[Predictor] | None = None,
    ) -> list[ClipResult]:
        """Score all rows, or only those of `predictors`, of all clips of a split, clip by clip."""
        results: list[ClipResult] = []
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # NumPy releases the GIL
            for made in self._predictions(plans, episodes, predictors or self.predictors):
                jobs = [
                    pool.submit(score, each, self.metrics, self.card, self.estimator)
                    for each in made
                ]
                results.extend(job.result() for job in jobs)
                self.advance(len(made))
        return results

    def sweep(self, plans: Sequence[ClipPlan], episodes: EpisodeDataset) -> StepsSweep:
        """Score the model on the first clip of each of the first episodes, per `steps_sweep` entry.

        Metrics that read states from video are left out (unless one is the headline), since reading
        them would take longer than predicting the clips.
        """
        quick = replace(self, metrics=quick_metrics(self.metrics, self.card))
        settings = {steps: replace(self.config, steps=steps) for steps in self.steps_sweep}
        return {
            steps: replace(quick, config=config).scores(self._swept(plans), episodes, ["model"])
            for steps, config in settings.items()
        }

    def count_rows(
        self, plans: Sequence[ClipPlan], predictors: Sequence[Predictor] | None = None
    ) -> int:
        """How many rows `scores` predicts for a split, plus those of `sweep` if no `predictors`."""
        rows = sum(len(predictors_for(plan, predictors or self.predictors)) for plan in plans)
        if predictors is None:
            rows += len(self.steps_sweep) * len(self._swept(plans))
        return rows

    def videos(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, results: Sequence[ClipResult]
    ) -> list[ShownClip]:
        """Videos of the best, median and worst clips, and the median ones with other actions too.

        Predicts these clips again with the same noise, so that `scores` need not keep all videos.
        `results` is what `scores` returned for `plans`.
        """
        by_clip = {(plan.episode, plan.start): plan for plan in plans}
        values = {(r.episode, r.start, r.kind): r.values for r in results}
        videos: list[ShownClip] = []
        higher = self.metrics[self.headline].higher_is_better
        for clip, pick in _pick_clips(results, self.headline, higher, self.config.videos).items():
            rows: list[Predictor] = ["model", "shuffled"] if pick == "median" else ["model"]
            (made,) = self._predictions([by_clip[clip]], episodes, rows)
            videos += [_shown(each, pick, values[*clip, each.predictor]) for each in made]
        return videos

    def _swept(self, plans: Sequence[ClipPlan]) -> list[ClipPlan]:
        first = {plan.episode: plan for plan in reversed(plans)}
        return [first[episode] for episode in sorted(first)[: self.config.sweep_episodes]]

    def _predictions(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, predictors: Sequence[Predictor]
    ) -> Iterator[list[Prediction]]:
        """Yield all rows of one batch of clips at a time."""
        for group in batches(load_samples(plans, episodes), self.config.batch_size):
            first, last = group[0].plan, group[-1].plan
            until = f" to episode {last.episode}, from frame {last.start}" if last != first else ""
            with noting(f"{first.where}{until}", *self.world_model.children()):
                made = self.predict(Batch.of(group, self.device), predictors)
            yield [
                Prediction(sample, each, made[each][place])
                for place, sample in enumerate(group)
                for each in predictors_for(sample.plan, predictors)
            ]


def _shown(prediction: Prediction, pick: str, values: Mapping[str, float]) -> ShownClip:
    sample, kind, plan = prediction.sample, prediction.predictor, prediction.sample.plan
    panels, frames = case_study(sample.video, prediction.video, sample.episode.masks)
    actions = sample.donor_actions if kind == "shuffled" else sample.episode.actions
    name = f"{plan.split}-{plan.episode:06d}" + (f"-{plan.start:04d}" if plan.start else "")
    return VideoRecord(
        file=f"{name}-{kind}.mp4",
        split=plan.split,
        episode=plan.episode,
        start=plan.start,
        ood_label=sample.episode.ood_label,
        pick=pick,
        kind=kind,
        values={name: finite(value) for name, value in values.items()},
        actions=actions.tolist(),
        panels=panels,
    ), frames


def _pick_clips(
    results: Sequence[ClipResult], name: str, higher_is_better: bool, count: int
) -> dict[tuple[int, int], str]:
    """The clips to show, best first: ``best``, ``median`` or ``worst`` by episode and start.

    Takes `count` of each, or fewer in a small split, ranked by the model's score in metric `name`.
    """
    sign = -1 if higher_is_better else 1
    rows = [r for r in results if r.kind == "model" and not math.isnan(r.values[name])]
    rows.sort(key=lambda r: (sign * r.values[name], r.episode, r.start))
    ranked = [(r.episode, r.start) for r in rows]
    middle = max(0, (len(ranked) - count) // 2)
    picks = dict.fromkeys(ranked[middle : middle + count], "median")
    picks |= dict.fromkeys(ranked[len(ranked) - count :], "worst")
    picks |= dict.fromkeys(ranked[:count], "best")
    return {clip: picks[clip] for clip in ranked if clip in picks}
