"""What an evaluation finds: the `Score` of each clip, and their `Summary`, ``summary.json``."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from acwm_core.errors import DataError
from acwm_core.evaluation.metric import MetricInfo as MetricInfo
from acwm_core.evaluation.protocol import PublishedComparison
from acwm_core.evaluation.statistics import Estimate as Estimate
from acwm_core.evaluation.statistics import Paired as Paired
from acwm_core.evaluation.statistics import defined as defined
from acwm_core.files import check_fetched, check_inside, read_json, written_whole

FOLDER = "evaluation"
SUMMARY = "summary.json"
VIDEOS = "videos"

DIVIDER = 2
"""Width of the dark line between the panels of a video, in pixels before magnification; even, as
H.264 needs."""

VideoFile = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.+=-]*\.mp4$", max_length=200)]
"""The name of a video in the folder of a run's videos, never a path."""


@dataclass(frozen=True)
class Score:
    """How well one row predicted one clip: a row of ``episodes.parquet``.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame with which the clip starts.
        ood_label: the factor that was shifted, if any.
        kind: the row, see `acwm_core.evaluation.clips.Predictor`.
        frames: number of frames that are scored.
        values: the score of the clip, by metric; NaN where it is not defined.
        weights: how much the clip counts in a metric's summary, by metric.
        curves: the score of each frame, by metric; NaN where it is not defined. Rounded to float32,
            as they are written.
        features: features `[2, D]` of each `SetMetric`.
        failed: whether the prediction is not finite; then all scores are `Metric.worst`.
        shares: `Metric.coverage` of each metric that reads states; none in results of older
            versions.
    """

    split: str
    episode: int
    start: int
    ood_label: str | None
    kind: str
    frames: int
    values: dict[str, float]
    weights: dict[str, float]
    curves: dict[str, list[float]]
    features: dict[str, list[list[float]]] = field(default_factory=dict[str, list[list[float]]])
    failed: bool = False
    shares: dict[str, float] = field(default_factory=dict[str, float])


@dataclass(frozen=True)
class SetSummary:
    """The scores of a set of clips.

    Attributes:
        clips: number of clips.
        episodes: number of episodes from which they are cut.
        rows: scores by row and metric.
        paired: the model against ``copy`` and ``shuffled``, by reference and metric.
        failed: number of predictions that were not finite, by row; each gets the worst score.
        undefined: number of the model's clips without a score, by metric; they are left out.
        shares: mean of `Score.shares` over clips, by row and metric; empty in older results.
    """

    clips: int
    rows: dict[str, dict[str, Estimate]]
    paired: dict[str, dict[str, Paired]]
    episodes: int = 0
    failed: dict[str, int] = field(default_factory=dict[str, int])
    undefined: dict[str, int] = field(default_factory=dict[str, int])
    shares: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])

    def failures(self, row: str = "model") -> str:
        """``3 of 12 predictions are not finite``; empty if all are finite."""
        count = self.failed.get(row)
        return f"{count} of {self.clips} predictions are not finite" if count else ""


@dataclass(frozen=True)
class StepsPoint:
    """The model's scores with one number of sampling steps.

    Attributes:
        steps: network evaluations per window.
        scores: by metric.
        change: by metric, the mean over clips of the score minus that with the most steps.
    """

    steps: int
    scores: dict[str, Estimate]
    change: dict[str, Estimate]


@dataclass(frozen=True)
class StepsCurve:
    """The model's scores against the number of sampling steps, on the same clips and noise.

    Attributes:
        clips: number of clips.
        points: in ascending order of steps.
    """

    clips: int
    points: list[StepsPoint]


@dataclass(frozen=True)
class ResponseCurve:
    """How strongly the video responds to a change of one dimension of the action.

    Attributes:
        dimension: name of the dimension.
        unit: unit of the dimension.
        size: requested shift in all frames, as a fraction of half the dimension's range.
        shift: mean change that remained after clipping to the bounds, in `unit`.
        truth: the true response per frame: root mean square difference over pixels and channels of
            values in [0, 1] between the simulated branch and the simulated factual clip.
        rows: by row and frame, the part of the predicted response along the true one, on the same
            scale: equal to `truth` is right, 0 is action-insensitive, negative is the wrong
            direction. None where there is no true response.
    """

    dimension: str
    unit: str
    size: float
    shift: float
    truth: list[float]
    rows: dict[str, list[float | None]]


@dataclass(frozen=True)
class Counterfactual:
    """Controllability: how accurate the responses to other actions from the same first frame are.

    For each row, over all its branches, the predicted response is split into ``gain`` times the
    true response and an uncorrelated remainder. ``residual`` is the energy of this remainder
    relative to the true response. The metric `response` is 1 − (1 − gain)² − residual.

    Attributes:
        clips: number of clips.
        frames: length of the longest one.
        branches: number of other action sequences, over all clips.
        rows: scores by row and metric, over all branches.
        kinds: the same by kind of branch: ``another`` (another episode's actions), ``still``,
            ``reversed`` (in time), ``mirrored``, and each action dimension by its name.
        gain: by kind of branch (and ``all``) and row; 1 is right.
        residual: likewise; 0 is right.
        curves: one per action dimension and size.
    """

    clips: int
    frames: int
    branches: int
    rows: dict[str, dict[str, Estimate]]
    kinds: dict[str, dict[str, dict[str, Estimate]]]
    gain: dict[str, dict[str, float | None]]
    residual: Annotated[
        dict[str, dict[str, float | None]],
        Field(validation_alias=AliasChoices("residual", "stray")),  # its former name
    ]
    curves: list[ResponseCurve]


@dataclass(frozen=True)
class Predictability:
    """The predictability horizon of the environment itself.

    The simulator starts about a millimetre off (see `Environment._perturb`) and takes the same
    actions.

    Attributes:
        clips: number of clips.
        share: mean squared error of that simulation per frame, as a share of the error of repeating
            the first frame; None where nothing has moved.
        horizon: the frame from which the share stays at or above `limit`; scores from there on say
            nothing about a model. None if the share is below at the end.
        limit: the share that counts as unpredictable.
    """

    clips: int
    share: list[float | None]
    horizon: int | None
    limit: float


@dataclass(frozen=True)
class Ensemble:
    """What a model draws against the simulator's futures from starts that differ invisibly.

    A frame's distance to another is the root mean square of their difference, of values in [0, 1].

    Attributes:
        clips: number of clips.
        starts: number of the simulator's futures of each.
        draws: number of the model's.
        moved: standard deviation by which things were moved at the start, in m (joints in rad):
            that of a place known to a pixel.
        distance: energy distance to the simulator's futures, 0 for the same distribution, mean over
            frames and clips: of the ``model``; of ``simulator``, one half of the futures against
            the other, the floor; of ``codec``, its reconstructions of them; and of ``copy``, the
            first frame.
        spread: mean distance of two different futures, of the rows that have several.
        curves: the distance of each frame, by row.
    """

    clips: int
    starts: int
    draws: int
    moved: float
    distance: dict[str, Estimate]
    spread: dict[str, Estimate]
    curves: dict[str, list[float | None]]


@dataclass(frozen=True)
class SplitSummary:
    """One test split.

    Attributes:
        scores: scores of all its clips.
        labels: scores of the clips of each `ood_label`; empty if there is none.
        horizon: the score of each frame over all clips, by row and metric.
        steps: scores against sampling steps; None if not requested.
        counterfactual: response to actions; None if not requested or not available.
        predictability: the predictability horizon; likewise.
    """

    scores: SetSummary
    labels: dict[str, SetSummary]
    horizon: dict[str, dict[str, list[float | None]]]
    steps: StepsCurve | None = None
    counterfactual: Counterfactual | None = None
    predictability: Predictability | None = None


@dataclass(frozen=True)
class Tracks:
    """Where a model sees things in the true frames of a clip, and where it expects them.

    Places are right and down, from 0 to 1 within the picture; None where it sees nothing.

    Attributes:
        names: of the N things.
        shares: how much the picture changes with each, as a share of the one that counts most.
        every: video frames from one row to the next.
        seen: in the true frames, read each by itself, `[L, N, 2]`.
        predicted: in the prediction, `[L, N, 2]`; those of the given frames are seen.
    """

    names: list[str]
    shares: list[float]
    every: int
    seen: list[list[list[float | None]]]
    predicted: list[list[list[float | None]]]


@dataclass(frozen=True)
class VideoRecord:
    """A video of one clip: truth, prediction, difference and the truth over the prediction.

    Attributes:
        file: file name in the folder ``videos``.
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame with which the clip starts.
        ood_label: the factor that was shifted, if any.
        pick: why it was chosen: ``"best"``, ``"median"`` or ``"worst"`` of its split, or
            ``"counterfactual"``.
        kind: the row that predicted it, ``"model"`` or ``"shuffled"``, or ``"branch:KIND"``.
        values: its scores by metric.
        actions: the actions that the model was given, `[T, A]`.
        panels: what its panels show, row by row.
        tracks: of the things that the model sees; None if it sees none, or other actions were
            taken.
    """

    file: VideoFile
    split: str
    episode: int
    ood_label: str | None
    pick: str
    kind: str
    values: dict[str, float | None]
    actions: list[list[float]]
    start: int = 0
    panels: list[list[str]] = field(default_factory=lambda: [["truth", "prediction", "difference"]])
    tracks: Tracks | None = None


@dataclass(frozen=True)
class Summary:
    """``summary.json``.

    Attributes:
        run: name of the run folder.
        parts: registered names of environment, codec, model and conditioner; of predictions that
            were handed in only the environment and, as the model, the entry's name.
        metrics: the metrics that were measured, in the order of the recipe.
        headline: the metric that ranks clips.
        splits: results per test split.
        gap: out of distribution minus in distribution, by row and metric; empty without both.
        environment: name, fps, action names, units and bounds.
        videos: the videos in the folder ``videos``.
        provenance: versions, hashes, dataset, settings and times.
        protocol: which clips were predicted, see `acwm_core.evaluation.protocol.Protocol`.
        left_out: metrics of the recipe and tests that could not be measured, and episodes that
            could not be read, and why.
        published: published scores of the same setting or environment; None if there are none.
        ensembles: the model's draws against the simulator's futures, per test split; empty if not
            requested or not available.
    """

    run: str
    parts: dict[str, str]
    metrics: dict[str, MetricInfo]
    headline: str
    splits: dict[str, SplitSummary]
    gap: dict[str, dict[str, Estimate]]
    environment: dict[str, Any]
    videos: list[VideoRecord] = field(default_factory=list[VideoRecord])
    provenance: dict[str, Any] = field(default_factory=dict[str, Any])
    protocol: str = "full"
    left_out: dict[str, str] = field(default_factory=dict[str, str])
    published: PublishedComparison | None = None
    ensembles: dict[str, Ensemble] = field(default_factory=dict[str, Ensemble])

    @property
    def handed_in(self) -> bool:
        """Whether predictions that were made elsewhere were scored, and not the model of a run."""
        return "predictions_sha256" in self.provenance

    @property
    def unfinished(self) -> str:
        """A phrase if the model was evaluated before its training had ended; else empty."""
        return unfinished(self.provenance)

    @property
    def predictor(self) -> str:
        """SHA-256 of what predicted: weights, or predictions that were handed in."""
        of = "predictions" if self.handed_in else "weights"
        return self.provenance[f"{of}_sha256"]

    def write(self, folder: Path) -> None:
        """Write ``summary.json`` into the evaluation folder of a run, without NaN or infinity."""
        write_json(folder / SUMMARY, self)

    @classmethod
    def read(cls, run: Path) -> Summary:
        """Read the summary of a run folder.

        Raises:
            DataError: the run was not evaluated, or with another version of acwm.
        """
        check_inside(run, f"{FOLDER}/**/*")
        evaluate = shlex.join(["acwm", "evaluate", str(run)])
        try:
            return cls.load(run / FOLDER / SUMMARY)
        except (FileNotFoundError, NotADirectoryError):
            if not run.is_dir():
                raise DataError(f"there is no run folder {run}") from None
            raise DataError(f"{run} was not evaluated: run `{evaluate}` first") from None
        except DataError as error:
            check_fetched(run / FOLDER / SUMMARY)
            raise DataError(f"{error}: run `{evaluate}` again") from None

    @classmethod
    def load(cls, path: Path) -> Summary:
        """Read a single result file, also one of the previous release.

        Raises:
            OSError: it cannot be read.
            DataError: it is damaged, or from another version of acwm.
        """
        summary = read_json(path, Summary, "a summary")
        scores = [split.scores.rows.get("model", {}) for split in summary.splits.values()]
        if not scores or not all(summary.headline in row for row in (summary.metrics, *scores)):
            raise DataError(
                f"{path} is not a whole summary: it lacks the model's {summary.headline}"
            )
        return summary


def unfinished(facts: Mapping[str, Any]) -> str:
    """How far a model is trained, by its facts in `Summary.provenance`, if that is not all."""
    done, planned = (facts.get(f"{name}_steps") for name in ("training", "planned"))
    if not planned or done is None or done >= planned:
        return ""
    return f"trained for {done:,} of {planned:,} steps"


def write_json(path: Path, result: object) -> None:
    """Write a dataclass of results, with null for NaN and infinity."""
    from pydantic import TypeAdapter

    adapter: TypeAdapter[Any] = TypeAdapter(type(result))
    with written_whole(path) as partial:
        partial.write_bytes(adapter.dump_json(result, indent=1) + b"\n")
