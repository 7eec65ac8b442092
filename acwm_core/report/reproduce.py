"""How an evaluated run came about: its protocol in words, and the commands to make it again."""

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
from acwm_core.evaluation.severity_results import read_severity
from acwm_core.recipe.compose import RENAMED, read_recipe

RECIPE = "recipe.yaml"


def commands(folder: Path, summary: Summary) -> list[str]:
    """The commands for the data, the run, its evaluation, its severity curves and its report.

    What the run's own recipe says of the evaluation is left out.

    Raises:
        RecipeError: the recipe in the run folder is damaged.
        DataError: so is a curve.
    """
    facts, data = summary.provenance, summary.provenance["dataset"]
    recipe = read_recipe(folder / RECIPE)
    section: dict[str, Any] = recipe.get("evaluation") or {}
    trained_on = str(recipe.get("data", {}).get("path", ""))
    fit: str = facts.get("imported") or shlex.join(["acwm", "fit", str(folder / RECIPE)])
    again = f"{folder}-again"
    lines: list[str] = []
    source: list[str] = []
    if not _same_folder(data["path"], trained_on):
        source = ["--data", origin(Path(data["path"])) or data["path"]]
        if not facts.get("imported") and (folder / CARD).is_file() and not _is_fetched(trained_on):
            lines.append(DatasetCard.read(folder / CARD).command(trained_on))
    if not _is_fetched(data["path"]):
        lines.append(data["command"])
    lines.append(f"{fit} {shlex.join(['--out', again])}")
    evaluations = [(summary.protocol, facts["evaluation"], list[str]())]
    for curve in read_severity(folder, facts["weights_sha256"]):
        settings = curve.provenance["evaluation"]
        evaluations.append((settings["protocol"], settings, ["--sweep", curve.text]))
    for protocol, settings, sweep in evaluations:
        overrides = _overrides(section, {**settings, "protocol": protocol})
        lines.append(shlex.join(["acwm", "evaluate", again, *overrides, *source, *sweep]))
    return [*lines, shlex.join(["acwm", "report", again])]


def evaluate_command(folder: Path, sweep: str = "") -> str:
    """What evaluates a run, or a factor of it, as its recipe says."""
    return f"acwm evaluate {folder}" + f" --sweep {shlex.quote(sweep)}" * bool(sweep)


def protocol_text(summary: Summary) -> str:
    """Which clips were predicted, and how: ``first 20 frames of each test episode, 5 sampling …``.

    Where not all episodes were taken, it says how many of each split.
    """
    facts = summary.provenance
    settings, there = facts["evaluation"], facts["dataset"]["episodes"]
    taken = {s: each.scores.episodes or each.scores.clips for s, each in summary.splits.items()}
    episodes = "test episode"
    if any(n < there[split] for split, n in taken.items()):
        counts = ", ".join(f"{n} of {there[split]} {split}" for split, n in taken.items())
        episodes = f"chosen episode ({counts})"
    clips = f"first {settings['frames']} frames" if settings["frames"] else "the whole"
    if settings["cuts"]:
        clips = f"{settings['cuts']} windows of {settings['frames']} frames"
    sampling = f"{facts['sampling_steps']} sampling steps, seed {settings['seed']}"
    return f"{clips} of each {episodes}, {sampling}"


def _overrides(section: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Overrides by which an evaluation departed from the section of the run's recipe."""
    known = {field.name for field in fields(EvaluationConfig)}  # runs of old may have had others
    given = EvaluationConfig(**{name: v for name, v in section.items() if name in known})
    wanted = {RENAMED["evaluation"].get(name, name): value for name, value in wanted.items()}
    return setting_overrides(given.to_dict(), wanted)


def _same_folder(path: str, other: str) -> bool:
    """Whether two paths, of which the second may be a URL, are of one dataset."""
    url = origin(Path(path))
    return url == other.rstrip("/") if url else Path(path).resolve() == Path(other).resolve()


def _is_fetched(path: str) -> bool:
    """Whether a dataset lies behind a URL, so that nobody needs to make it."""
    return "://" in path or origin(Path(path)) is not None
