"""`Evaluator`: predicts clips batch by batch, scores them, and makes videos of some."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.denoiser import Denoiser
from acwm_core.environment import EnvironmentCard
from acwm_core.errors.plugin_code import blaming
from acwm_core.estimator import StateEstimator
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.clips import PREDICTORS, Batch, ClipPlan, Predictor, batches, load_samples
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.results import VideoRecord
from acwm_core.evaluation.scoring import (
    Prediction,
    headline_of,
    needs_estimator,
    predictors_for,
    quick_metrics,
    score,
)
from acwm_core.evaluation.videos import case_study
from acwm_core.metric import Metric
from acwm_core.shapes import Actions, Video
from acwm_core.statistics import finite
from acwm_core.world_model import WorldModel

Results = Mapping[str, list[ClipResult]]
"""Results by split."""

StepsSweep = Mapping[int, list[ClipResult]]
"""Results of the model's row by the number of sampling steps."""

ShownClip = tuple[VideoRecord, NDArray[np.uint8]]
"""A record and its frames `[T, H, W, 3]`."""


@dataclass(frozen=True)
class Evaluator:
    """Everything that scoring takes.

    Attributes:
        world_model: in evaluation mode, on the device where it is to run.
        card: the environment's card, for the metrics.
        metrics: by registered name.
        config: settings.
        estimator: reads states from video for the metrics; None if there is none.
        left_out: metrics that cannot be measured here, and why.
        advance: told how many clips more were predicted and scored, in one row each.
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
        """The rows that `scores` predicts: the truth only for metrics that read states of it."""
        reads = any(needs_estimator(metric, self.card) for metric in self.metrics.values())
        return tuple(each for each in PREDICTORS if reads or each != "truth")

    @property
    def given(self) -> int:
        """How many first frames of a clip the model is given."""
        return self.config.context_frames or self.world_model.context_frames

    @property
    def steps_sweep(self) -> tuple[int, ...]:
        """Numbers of sampling steps to compare; none for a model that has no choice of them."""
        has_choice = isinstance(self.world_model.model, Denoiser)
        return self.config.steps_sweep if has_choice else ()

    @property
    def device(self) -> torch.device:
        """Where the model runs."""
        return self.world_model.action_low.device

    def predict(self, batch: Batch, predictors: Sequence[Predictor]) -> dict[Predictor, Video]:
        """What some rows predict of clips, `[B, T, 3, H, W]` float32 on the CPU."""

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
        """All rows of all clips of a split, or only those of some `predictors`, clip by clip."""
        results: list[ClipResult] = []
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # numpy lets go of the GIL
            for made in self._predictions(plans, episodes, predictors or self.predictors):
                jobs = [
                    pool.submit(score, each, self.metrics, self.card, self.estimator)
                    for each in made
                ]
                results.extend(job.result() for job in jobs)
                self.advance(len(made))
        return results

    def sweep(self, plans: Sequence[ClipPlan], episodes: EpisodeDataset) -> StepsSweep:
        """The model's row of the first episodes' first clips, by each number in `steps_sweep`.

        To read states of so many videos would take longer than to predict them.
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
        """How many rows of clips `scores` predicts of a split, and `sweep` if no `predictors`."""
        rows = sum(len(predictors_for(plan, predictors or self.predictors)) for plan in plans)
        if predictors is None:
            rows += len(self.steps_sweep) * len(self._swept(plans))
        return rows

    def videos(
        self, plans: Sequence[ClipPlan], episodes: EpisodeDataset, results: Sequence[ClipResult]
    ) -> list[ShownClip]:
        """Videos of the best, median and worst clips, the median's with other actions too.

        Predicts them once more, with the same noise, so that not all have to be kept. `results` is
        what `scores` returned for them.
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
        """All rows of a batch of clips at a time."""
        for group in batches(load_samples(plans, episodes), self.config.batch_size):
            first, last = group[0].plan, group[-1].plan
            until = f" to episode {last.episode}, from frame {last.start}" if last != first else ""
            with blaming(f"{first.where}{until}"):
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
    """``best``, ``median`` or ``worst`` of the clips to show, by episode and start, best first.

    So many of each, or fewer where the split is small, by the model's score in the metric `name`.
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
