"""What an evaluation found, summed up: ``summary.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.estimates import Estimate as Estimate
from acwm_core.evaluation.estimates import finite as finite
from acwm_core.evaluation.findings import Counterfactual, Predictability
from acwm_core.evaluation.published import Published
from acwm_core.metric import MetricInfo as MetricInfo

FOLDER = "evaluation"
SUMMARY = "summary.json"
VIDEOS = "videos"


@dataclass(frozen=True)
class Paired:
    """The model against a reference row on the same clips.

    Attributes:
        difference: mean of model − reference over clips.
        better: in how many clips the model was strictly better.
        clips: of how many, those that are defined in both rows.
    """

    difference: Estimate
    better: int
    clips: int


@dataclass(frozen=True)
class Scores:
    """The scores of a set of clips.

    Attributes:
        clips: how many.
        episodes: from how many episodes they are cut.
        rows: by row and metric.
        paired: the model against ``copy`` and ``shuffled``, by metric.
    """

    clips: int
    rows: dict[str, dict[str, Estimate]]
    paired: dict[str, dict[str, Paired]]
    episodes: int = 0


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
class SplitSummary:
    """One test split.

    Attributes:
        scores: of all its clips.
        labels: of the clips of each `ood_label`; empty if there is none.
        horizon: the score of each frame over all clips, by row and metric.
        steps: scores against sampling steps; None if they were not asked for.
        counterfactual: answers to other actions; None if they were not asked for or cannot be had.
        predictability: how long clips can be foreseen; likewise.
    """

    scores: Scores
    labels: dict[str, Scores]
    horizon: dict[str, dict[str, list[float | None]]]
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

    file: str
    split: str
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
        protocol: which clips were predicted, see `acwm_core.evaluation.config.Protocol`.
        left_out: metrics of the recipe, and tests, that could not be measured, and why.
        published: what the paper reports of the same setting or environment; None if nothing.
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
    published: Published | None = None

    def write(self, folder: Path) -> None:
        """Write ``summary.json`` into the evaluation folder of a run, without NaN or infinity."""
        from pydantic import TypeAdapter

        with written_whole(folder / SUMMARY) as partial:
            partial.write_bytes(TypeAdapter(Summary).dump_json(self, indent=1) + b"\n")

    @classmethod
    def read(cls, run: Path) -> Summary:
        """Read the summary of a run folder.

        Raises:
            DataError: the run was not evaluated, or by another version of acwm.
        """
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
        """Read a result file by itself.

        Raises:
            OSError: it cannot be read.
            DataError: it is damaged, or of another version of acwm.
        """
        from pydantic import TypeAdapter, ValidationError

        try:
            return TypeAdapter(Summary).validate_json(path.read_bytes())
        except ValidationError as error:
            reason = error.errors()[0]
            where = ".".join(map(str, reason["loc"]))
            why = f"{where}: {reason['msg']}" if where else reason["msg"]
            raise DataError(f"{path} is not a summary of this version of acwm ({why})") from None
