"""What an evaluation found, summed up: ``summary.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.benchmark import Published
from acwm_core.evaluation.facts import Environment, Name, Provenance, VideoFile
from acwm_core.metric import MetricInfo as MetricInfo
from acwm_core.statistics import Estimate as Estimate
from acwm_core.statistics import Paired as Paired
from acwm_core.statistics import defined as defined
from acwm_core.untrusted import check_folder, read_json

FOLDER = "evaluation"
SUMMARY = "summary.json"
VIDEOS = "videos"


@dataclass(frozen=True)
class Scores:
    """The scores of a set of clips.

    Attributes:
        clips: how many.
        episodes: from how many episodes they are cut.
        rows: by row and metric.
        paired: the model against ``copy`` and ``shuffled``, by metric.
        failed: by row, how many predictions were not finite; each scores infinitely badly.
        undefined: by metric, on how many of the model's clips it is not defined; they are left out.
    """

    clips: int
    rows: dict[Name, dict[Name, Estimate]]
    paired: dict[Name, dict[Name, Paired]]
    episodes: int = 0
    failed: dict[str, int] = field(default_factory=dict[str, int])
    undefined: dict[str, int] = field(default_factory=dict[str, int])

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
        change: by metric, the mean over clips of what it scores beyond the most steps of the curve.
    """

    steps: int
    scores: dict[str, Estimate]
    change: dict[str, Estimate]


@dataclass(frozen=True)
class StepsCurve:
    """The model's scores against the number of sampling steps, on the same clips and noise.

    Attributes:
        clips: how many.
        points: in rising order of steps.
    """

    clips: int
    points: list[StepsPoint]


@dataclass(frozen=True)
class ResponseCurve:
    """How strongly the video responds to a change of one dimension of the action.

    Attributes:
        dimension: its name.
        unit: its unit.
        size: what was asked for: a shift by this share of half the dimension's range, throughout.
        shift: mean change that was left of it within the bounds, in the unit.
        truth: per frame the true response: root mean square difference over pixels and channels of
            values in [0, 1] between the simulated branch and the simulated factual clip.
        rows: by row and frame the part of the predicted response that is the true one, in the same
            unit: equal to `truth` is right, 0 is action-insensitive, negative is the wrong way.
            None where there is no true response.
    """

    dimension: str
    unit: str
    size: float
    shift: float
    truth: list[float]
    rows: dict[str, list[float | None]]


@dataclass(frozen=True)
class Counterfactual:
    """Controllability: how right the responses to other actions from the same first frame are.

    For each row, all its branches pooled, the predicted response is ``gain`` times the true one and
    a rest that has nothing to do with it, whose energy relative to the true response's is
    ``residual``. The metric `response` is 1 − (1 − gain)² − residual.

    Attributes:
        clips: how many.
        frames: length of each.
        branches: other action sequences of all clips together.
        rows: by row and metric, over all branches.
        kinds: the same by kind of branch: ``another`` (another episode's actions), ``still``,
            ``reversed`` (in time), ``mirrored``, and each action dimension by its name.
        gain: by kind of branch, and ``all``, by row; 1 is right.
        residual: likewise; 0 is right.
        curves: by action dimension and size.
    """

    clips: int
    frames: int
    branches: int
    rows: dict[Name, dict[Name, Estimate]]
    kinds: dict[str, dict[Name, dict[Name, Estimate]]]
    gain: dict[str, dict[Name, float | None]]
    residual: Annotated[
        dict[str, dict[Name, float | None]],
        Field(validation_alias=AliasChoices("residual", "stray")),  # as it was called once
    ]
    curves: list[ResponseCurve]


@dataclass(frozen=True)
class Predictability:
    """The predictability horizon of the environment itself.

    The simulator starts a millimetre off (see `Environment._perturb`) and takes the same actions.

    Attributes:
        clips: how many.
        share: per frame the mean squared error of that simulation, as a share of what the first
            frame, standing still, has; None where nothing has moved.
        horizon: the frame from which on the share stays at or above `limit`: scores of later
            frames tell nothing of a model. None if it is below at the end.
        limit: the share that counts as unpredictable.
    """

    clips: int
    share: list[float | None]
    horizon: int | None
    limit: float


@dataclass(frozen=True)
class SplitSummary:
    """One test split.

    Attributes:
        scores: of all its clips.
        labels: of the clips of each `ood_label`; empty if there is none.
        horizon: the score of each frame over all clips, by row and metric.
        steps: scores against sampling steps; None if they were not asked for.
        counterfactual: action response; None if it was not asked for or cannot be had.
        predictability: the predictability horizon; likewise.
    """

    scores: Scores
    labels: dict[str, Scores]
    horizon: dict[Name, dict[Name, list[float | None]]]
    steps: StepsCurve | None = None
    counterfactual: Counterfactual | None = None
    predictability: Predictability | None = None


@dataclass(frozen=True)
class VideoRecord:
    """A video of one clip: truth, prediction, difference and the truth over the prediction.

    Attributes:
        file: name in the folder ``videos``.
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame that is the clip's first.
        ood_label: the factor that was shifted, if any.
        pick: why it was chosen, ``"best"``, ``"median"`` or ``"worst"`` of its split.
        kind: the row that predicted it, ``"model"`` or ``"shuffled"``.
        values: its scores by metric.
        actions: the rows that the model was given, `[T, A]`.
        panels: what its panels show, row by row.
    """

    file: VideoFile
    split: Name
    episode: int
    ood_label: str | None
    pick: str
    kind: str
    values: dict[str, float | None]
    actions: list[list[float]]
    start: int = 0
    panels: list[list[str]] = field(default_factory=lambda: [["truth", "prediction", "difference"]])


@dataclass(frozen=True)
class Summary:
    """``summary.json``.

    Attributes:
        run: name of the run folder.
        parts: registered names of environment, codec, model and conditioner.
        metrics: what was measured, in the order of the recipe.
        headline: the metric that ranks clips.
        splits: results per test split.
        gap: out of distribution minus in distribution, by row and metric; empty without both.
        environment: name, fps, action names, units and bounds.
        videos: what lies in the folder ``videos``.
        provenance: versions, hashes, dataset, settings and times.
        protocol: which clips were predicted, see `acwm_core.evaluation.benchmark.Protocol`.
        left_out: metrics of the recipe, and tests, that could not be measured, and why.
        published: what is published of the same setting or environment; None if nothing.
    """

    run: str
    parts: dict[str, str]
    metrics: dict[Name, MetricInfo]
    headline: Name
    splits: dict[Name, SplitSummary]
    gap: dict[str, dict[str, Estimate]]
    environment: Environment
    videos: list[VideoRecord] = field(default_factory=list[VideoRecord])
    provenance: Provenance = field(default_factory=dict[str, Any])
    protocol: str = "full"
    left_out: dict[str, str] = field(default_factory=dict[str, str])
    published: Published | None = None

    def write(self, folder: Path) -> None:
        """Write ``summary.json`` into the evaluation folder of a run, without NaN or infinity."""
        write_json(folder / SUMMARY, self)

    @classmethod
    def read(cls, run: Path) -> Summary:
        """Read the summary of a run folder.

        Raises:
            DataError: the run was not evaluated, or by another version of acwm.
        """
        check_folder(run)
        try:
            return cls.load(run / FOLDER / SUMMARY)
        except (FileNotFoundError, NotADirectoryError):
            if not run.is_dir():
                raise DataError(f"there is no run folder {run}") from None
            raise DataError(f"{run} was not evaluated: run `acwm evaluate {run}` first") from None
        except DataError as error:
            raise DataError(f"{error}: run `acwm evaluate {run}` again") from None

    @classmethod
    def load(cls, path: Path) -> Summary:
        """Read a result file by itself, one of the last release too.

        Raises:
            OSError: it cannot be read.
            DataError: it is damaged, or of another version of acwm.
        """
        found = read_json(path, Summary, "a summary")
        scores = [split.scores.rows.get("model", {}) for split in found.splits.values()]
        if not scores or not all(found.headline in row for row in (found.metrics, *scores)):
            raise DataError(f"{path} is not a whole summary: it lacks the model's {found.headline}")
        return found


def write_json(path: Path, result: object) -> None:
    """Write a dataclass of results, with null for NaN and infinity."""
    from pydantic import TypeAdapter

    adapter: TypeAdapter[Any] = TypeAdapter(type(result))
    with written_whole(path) as partial:
        partial.write_bytes(adapter.dump_json(result, indent=1) + b"\n")
