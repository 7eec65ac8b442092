"""`commands`: what makes an evaluated run and its report again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.remote import origin
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.severity_results import curves_of
from acwm_core.recipe.compose import read_recipe

RECIPE = "recipe.yaml"


def commands(folder: Path, summary: Summary) -> list[str]:
    """What to type to make the data, the run, its evaluation, its curves and its report again.

    What the run's own recipe says of the evaluation is left out.

    Raises:
        RecipeError: the recipe in the run folder is damaged.
        DataError: so is a curve.
    """
    data: dict[str, Any] = summary.provenance["dataset"]
    recipe = read_recipe(folder / RECIPE)
    trained_on = str(recipe.get("data", {}).get("path", ""))
    imported: str | None = summary.provenance.get("imported")
    again = f"{folder}-again"
    section: dict[str, Any] = recipe.get("evaluation") or {}
    settings = {**summary.provenance["evaluation"], "protocol": summary.protocol}
    lines: list[str] = []
    source: list[str] = []
    if not _same_folder(data["path"], trained_on):
        source = ["--data", origin(Path(data["path"])) or data["path"]]
        if not imported and (folder / CARD).is_file() and not _is_fetched(trained_on):
            lines.append(DatasetCard.read(folder / CARD).command(trained_on))
    if not _is_fetched(data["path"]):
        lines.append(data["command"])
    evaluate = ["acwm", "evaluate", again]
    sweeps = [
        [*_overrides(section, curve.provenance["evaluation"]), *source, "--sweep", curve.text]
        for curve in curves_of(folder, summary.provenance["weights_sha256"])
    ]
    return [
        *lines,
        f"{imported or _join('acwm', 'fit', folder / RECIPE)} {_join('--out', again)}",
        _join(*evaluate, *_overrides(section, settings), *source),
        *(_join(*evaluate, *sweep) for sweep in sweeps),
        _join("acwm", "report", again),
    ]


def _overrides(section: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Words and options by which an evaluation departed from the section of the run's recipe."""
    protocol: str = wanted["protocol"]
    known = {field.name for field in fields(EvaluationConfig)}  # runs of old may have had others
    given: dict[str, Any] = {name: value for name, value in section.items() if name in known}
    changed = protocol != given.get("protocol", "full")
    given["protocol"] = protocol
    cuts = given.pop("cuts", None)
    if protocol != "full":
        given["cuts"] = cuts
    overrides = setting_overrides(EvaluationConfig(**given).to_dict(), wanted)
    if protocol == "full" and cuts is not None:
        overrides.append("evaluation.cuts=null")  # the protocol takes none and would refuse them
    return [*overrides, *(["--protocol", protocol] if changed else [])]


def _same_folder(path: str, other: str) -> bool:
    """Whether two paths, of which the second may be a URL, are of one dataset."""
    url = origin(Path(path))
    return url == other.rstrip("/") if url else Path(path).resolve() == Path(other).resolve()


def _is_fetched(path: str) -> bool:
    """Whether a dataset lies behind a URL, so that nobody needs to make it."""
    return "://" in path or origin(Path(path)) is not None


def _join(*overrides: object) -> str:
    return shlex.join(map(str, overrides))
