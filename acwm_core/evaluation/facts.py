"""What result files must hold beside scores. It is checked, as files may come from anyone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from acwm_core.untrusted import typed

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_-]*$", max_length=100)]
"""Name of a split, row, metric or factor; it is used in file names and in ids on a page."""

VideoFile = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.+=-]*\.mp4$", max_length=200)]
"""The name of a video in the folder of a run's videos, never a path."""


@dataclass(frozen=True)
class _Dataset:
    path: str
    frame_size: tuple[int, int]
    episodes: dict[str, int]
    checksums: dict[str, str]
    command: str


@dataclass(frozen=True)
class _Provenance:
    evaluated: str
    weights_sha256: str
    training_steps: int
    parameters: int
    sampling_steps: int
    codec_fingerprint: str
    evaluation: dict[str, Any]
    dataset: _Dataset
    versions: dict[str, str]
    device: str
    recipe_sha256: str
    recipe: str
    imported: str | None = None
    estimator: dict[str, str] | None = None


@dataclass(frozen=True)
class _Action:
    names: list[str]
    units: list[str]
    low: list[float]
    high: list[float]

    def __post_init__(self) -> None:
        if len({*map(len, (self.names, self.units, self.low, self.high))}) != 1:
            raise ValueError("it needs a name, a unit, a low and a high per dimension")


@dataclass(frozen=True)
class _Environment:
    name: str
    summary: str
    fps: Annotated[int, Field(gt=0)]
    action: _Action
    citation: str


def _holding(kind: type[Any]) -> AfterValidator:
    """Validator that checks that a dict holds at least the fields of `kind`, and returns it."""

    def check(values: dict[str, Any]) -> dict[str, Any]:
        if values:
            typed(values, kind)
        return values

    return AfterValidator(check)


Provenance = Annotated[dict[str, Any], _holding(_Provenance)]
"""Where results come from, see `acwm_core.evaluation.provenance`."""

Environment = Annotated[dict[str, Any], _holding(_Environment)]
"""Name, summary, fps, actions and citation of an environment."""
