"""`Evaluator`: predicts clips batch by batch, scores them, and makes videos of a few."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import noting
from acwm_core.evaluation.clips import (
    PREDICTORS,
    Clip,
    Predictor,
    donor_actions,
    draw_seeds,
    read_clips,
)
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.draws import metrics_for, score_draws
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.evaluation.results import Score
from acwm_core.evaluation.score import (
    headline_of,
    needs_estimator,
    predictors_for,
    quick_metrics,
    score,
)
from acwm_core.evaluation.tracks import tracks_of
from acwm_core.evaluation.videos import ClipVideo, pick_clips, video_of
from acwm_core.model.shapes import Actions, Video
from acwm_core.model.world_model import Mode


class Reconstruction(Protocol):
    """What is done to frames on their way through a model, such as its codec."""

    def __call__(self, video: Video, /) -> Video:
        """The frames after it."""
        ...

    def fingerprint(self) -> str:
        """What it depends on."""
        ...


class VideoModel(Protocol):
    """What an evaluation asks of a model: a `WorldModel`, or predictions that were made elsewhere.

    Attributes are those of `WorldModel`.
    """

    @property
    def context_frames(self) -> int: ...  # noqa: D102
    @property
    def clip_frames(self) -> int: ...  # noqa: D102
    @property
    def steps(self) -> int | None: ...  # noqa: D102
    @property
    def samples(self) -> bool: ...  # noqa: D102
    @property
    def device(self) -> torch.device: ...  # noqa: D102
    @property
    def codec(self) -> Reconstruction: ...  # noqa: D102
    def children(self) -> Iterable[object]: ...  # noqa: D102
    def rollout_chunks(  # noqa: D102
        self,
        given: Video,
        actions: Actions,
        *,
        mode: Mode | None,
        steps: int | None,
        seeds: Sequence[int] | None,
    ) -> Iterator[Video]: ...


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
        rows: what can predict here; all of `PREDICTORS` by default.
        advance: progress callback, called with the number of newly scored predictions.
    """

    world_model: VideoModel
    card: EnvironmentCard
    metrics: Mapping[str, Metric]
    config: EvaluationConfig
    estimator: StateEstimator | None = None
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    rows: Sequence[Predictor] = PREDICTORS
    advance: Callable[[int], None] = lambda count: None

    @property
    def headline(self) -> str:
        """The metric that ranks clips and heads the report."""
        return headline_of(self.metrics)

    @property
    def predictors(self) -> tuple[Predictor, ...]:
        """The rows that `scores` predicts; ``truth`` only if a metric reads states from video."""
        reads = any(needs_estimator(metric, self.card) for metric in self.metrics.values())
        return tuple(row for row in self.rows if reads or row != "truth")

    @property
    def draws(self) -> int:
        """How many draws of a clip are predicted, to be scored together; 0 if one is enough."""
        if self.config.samples == 1:
            return 0
        return self.config.samples if self.world_model.samples else 1

    @property
    def given(self) -> int:
        """How many context frames of a clip the model is given."""
        return self.config.context_frames or self.world_model.context_frames

    @property
    def steps_sweep(self) -> tuple[int, ...]:
        """Numbers of sampling steps to compare; empty for a model without sampling steps."""
        return self.config.steps_sweep if self.world_model.steps else ()

    @property
    def device(self) -> torch.device:
        """The device on which the model runs."""
        return self.world_model.device

    def truths(self, clips: Iterable[Clip], episodes: EpisodeDataset) -> Iterator[Prediction]:
        """The true video of each clip, as a prediction of itself."""
        for clip, episode in read_clips(clips, episodes):
            yield Prediction.truth(episode, self.card, self.estimator, clip)

    def predict(
        self,
        truths: Sequence[Prediction],
        kinds: Sequence[Predictor],
        donated: Sequence[NDArray[np.float32]] = (),
        draws: int = 0,
    ) -> list[Prediction]:
        """Predict clips of one length, in one batch; all `kinds` of the first clip come first.

        Args:
            truths: the true clips; the model is given their context frames and actions.
            kinds: what predicts them, of `PREDICTORS`.
            donated: another episode's actions for each clip, for ``shuffled``.
            draws: how many `Prediction.draws` the model makes of each clip; 0 for none.
        """
        given, number = truths[0].clip.given, max(draws, 1)
        seeds_of_clips = [draw_seeds(truth.clip.seed, number) for truth in truths]
        seeds = [own[draw] for draw in range(number) for own in seeds_of_clips]
        true = torch.stack([truth.target for truth in truths]).to(self.device)

        def rollout(actions: Sequence[NDArray[np.float32]]) -> Video:
            first, times = true[:, :given], len(actions) // len(truths)
            chunks = self.world_model.rollout_chunks(
                torch.cat([first] * times) if times > 1 else first,
                torch.as_tensor(np.stack(actions), device=self.device),
                mode=self.config.mode,
                steps=self.config.steps,
                seeds=seeds[: len(actions)],
            )
            return torch.cat([*chunks], 1)

        makers: dict[Predictor, Callable[[], Video]] = {
            "model": lambda: rollout([truth.actions for truth in truths] * number),
            "shuffled": lambda: rollout(donated),
            "copy": lambda: true[:, given - 1, None].expand_as(true),
            "codec": lambda: self.world_model.codec(true),
            "truth": lambda: true,
        }
        with torch.inference_mode(), torch.autocast(self.device.type, enabled=False):
            videos = {kind: makers[kind]().float().cpu() for kind in kinds}
        return [
            _prediction(truth, kind, videos[kind][place :: len(truths)], several=draws > 0)
            for place, truth in enumerate(truths)
            for kind in predictors_for(truth.clip, kinds)
        ]

    def predictions(
        self,
        clips: Iterable[Clip],
        episodes: EpisodeDataset,
        kinds: Sequence[Predictor],
        draws: int = 0,
    ) -> Iterator[list[Prediction]]:
        """Predict clips batch by batch: successive clips of equal length together.

        A batch has fewer clips where several are drawn of each, so that it takes no more memory.
        """
        size = max(1, self.config.batch_size // max(draws, 1))
        for _, alike in itertools.groupby(
            self.truths(clips, episodes), lambda truth: len(truth.target)
        ):
            while truths := list(itertools.islice(alike, size)):
                first, last = truths[0].clip, truths[-1].clip
                until = f" to episode {last.episode}, from frame {last.start}"
                donated = (
                    [donor_actions(truth.clip, truth.actions, episodes) for truth in truths]
                    if "shuffled" in kinds
                    else []
                )
                with noting(first.where + until * (last != first), *self.world_model.children()):
                    predictions = self.predict(truths, kinds, donated, draws)
                yield predictions

    def scores(
        self,
        clips: Sequence[Clip],
        episodes: EpisodeDataset,
        kinds: Sequence[Predictor] | None = None,
    ) -> list[Score]:
        """Score all rows, or only those of `kinds`, of all clips of a split, clip by clip."""
        scores: list[Score] = []
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # NumPy releases the GIL
            for predictions in self.predictions(
                clips, episodes, kinds or self.predictors, self.draws
            ):
                for rows in pool.map(self._rows, predictions):
                    scores += rows
                self.advance(len(predictions))
        return scores

    def _rows(self, prediction: Prediction) -> list[Score]:
        if prediction.draws:
            return score_draws(prediction.draws, self.metrics)
        return [score(prediction, self.metrics)]

    def sweep(self, clips: Sequence[Clip], episodes: EpisodeDataset) -> dict[int, list[Score]]:
        """Score the model on the first clip of each of the first episodes, per `steps_sweep` entry.

        Metrics that read states from video are left out (unless one is the headline), since reading
        them would take longer than predicting the clips.
        """
        metrics = metrics_for(quick_metrics(self.metrics, self.card), samples=1)
        quick = replace(self, metrics=metrics)
        settings = {s: replace(self.config, steps=s, samples=1) for s in self.steps_sweep}
        return {
            steps: replace(quick, config=config).scores(self._swept(clips), episodes, ["model"])
            for steps, config in settings.items()
        }

    def count_rows(self, clips: Sequence[Clip], kinds: Sequence[Predictor] | None = None) -> int:
        """How many rows `scores` makes of a split, and of `sweep` if no `kinds` are given."""
        rows = sum(len(predictors_for(clip, kinds or self.predictors)) for clip in clips)
        return rows + (len(self.steps_sweep) * len(self._swept(clips)) if kinds is None else 0)

    def videos(
        self, clips: Sequence[Clip], episodes: EpisodeDataset, scores: Sequence[Score]
    ) -> list[ClipVideo]:
        """Videos of the best, median and worst clips, and the median ones with other actions too.

        Predicts these clips again with the same noise, so that `scores` need not keep all videos.
        """
        by_place = {(clip.episode, clip.start): clip for clip in clips}
        values = {(s.episode, s.start, s.kind): s.values for s in scores}
        videos: list[ClipVideo] = []
        higher = self.metrics[self.headline].higher_is_better
        for place, pick in pick_clips(scores, self.headline, higher, self.config.videos).items():
            clip = by_place[place]
            wanted = ("model", "shuffled") if pick == "median" else ("model",)
            kinds: list[Predictor] = [kind for kind in wanted if kind in self.rows]
            (predictions,) = self.predictions([clip], episodes, kinds)
            for prediction in predictions:
                actions = prediction.actions
                if prediction.kind == "shuffled":
                    actions = donor_actions(clip, actions, episodes)
                start = f"-{clip.start:04d}" if clip.start else ""
                kind = prediction.kind
                file = f"{clip.split}-{clip.episode:06d}{start}-{kind}.mp4"
                own = values[*place, kind]
                record, frames = video_of(
                    prediction, file, kind=kind, pick=pick, actions=actions, values=own
                )
                if kind == "model":
                    record = replace(record, tracks=tracks_of(self.world_model, prediction))
                videos.append((record, frames))
        return videos

    def _swept(self, clips: Sequence[Clip]) -> list[Clip]:
        first = {clip.episode: clip for clip in reversed(clips)}
        return [first[episode] for episode in sorted(first)[: self.config.sweep_episodes]]


def _prediction(truth: Prediction, kind: Predictor, videos: Video, *, several: bool) -> Prediction:
    """What a row predicts of a clip; `videos` `[N, T, 3, H, W]` has its draws if there are any."""
    predicted = replace(truth, video=videos[0], kind=kind)
    if kind != "model" or not several:
        return predicted
    return replace(predicted, draws=tuple(replace(predicted, video=video) for video in videos))
