"""The commands that reproduce an evaluated run, from its data to its report."""

from __future__ import annotations

import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.remote import origin
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.evaluation.results import Summary
from acwm_core.recipe.compose import read_recipe
from acwm_core.recipe.former import current_settings
from acwm_severity.curves import read_severity


def commands(folder: Path, summary: Summary) -> list[str]:
    """The commands for the data, the run, its evaluation, its severity curves and its report.

    Evaluation settings that the run's own recipe already contains are not repeated.
    """
    facts, data = summary.provenance, summary.provenance["dataset"]
    if summary.handed_in:
        own = facts["predictions"], summary.parts["env"], "--tasks", facts["tasks"]
        again = f"{folder.parent}-again"
        score = shlex.join(["acwm", "score", *own, "--data", data["path"], "--out", again])
        made = [] if _is_fetched(data["path"]) or not data["command"] else [data["command"]]
        return [*made, score, shlex.join(["acwm", "report", f"{again}/{folder.name}"])]
    original = folder / "recipe.yaml"
    recipe = read_recipe(original)
    trained_on, tested_on = str(recipe.get("data", {}).get("path", "")), Path(data["path"])
    url, again = origin(tested_on), f"{folder}-again"
    generated, source = list[str](), list[str]()
    if trained_on.rstrip("/") != url and Path(trained_on).resolve() != tested_on.resolve():
        source = ["--data", url or data["path"]]
        if not facts.get("imported") and (folder / CARD).is_file() and not _is_fetched(trained_on):
            generated.append(DatasetCard.read(folder / CARD).command(trained_on))
    if not _is_fetched(data["path"]):
        generated.append(data["command"])
    fit: str = facts.get("imported") or shlex.join(["acwm", "fit", str(original)])
    evaluations = [({**facts["evaluation"], "protocol": summary.protocol}, list[str]())]
    for curve in read_severity(folder, facts["weights_sha256"]):
        evaluations.append((curve.provenance["evaluation"], ["--sweep", curve.text]))
    known = {field.name for field in fields(EvaluationConfig)}  # old recipes may have others
    settings: dict[str, Any] = recipe.get("evaluation") or {}
    given = EvaluationConfig(**{name: v for name, v in settings.items() if name in known}).to_dict()
    lines = [
        [
            "acwm",
            "evaluate",
            again,
            *setting_overrides(given, current_settings(wanted)),
            *source,
            *sweep,
        ]
        for wanted, sweep in evaluations
    ]
    evaluated = map(shlex.join, [*lines, ["acwm", "report", again]])
    return [*generated, f"{fit} {shlex.join(['--out', again])}", *evaluated]


def _is_fetched(path: str) -> bool:
    return "://" in path or origin(Path(path)) is not None
