"""The model card of a trained model: what it is, how it was made, and how good it is."""

from __future__ import annotations

import csv
import html
import io
import math
from pathlib import Path
from typing import Any

from acwm_core.data.card import DatasetCard
from acwm_core.errors import DataError
from acwm_core.evaluation.results import Estimate, Summary
from acwm_core.evaluation.shares import error_shares
from acwm_core.recipe import Recipe
from acwm_core.training.run import read_metadata
from acwm_core.training.run_folder import RunFolder
from acwm_report.titles import short_title

SPLITS = {"ind_test": "in distribution", "ood_test": "out of distribution"}

BESIDE = ("model", "codec", "perturbed", "copy")
"""The rows that stand beside each other at the end of a card."""

CURVE_POINTS = 8
"""Number of training steps in the card's learning curve."""

SHOWN, MAX_BYTES = ("val/loss", "val/psnr"), 64_000_000
"""Columns of the learning curve, and the largest size of the metrics file in bytes."""


def model_card(folder: RunFolder, summary: Summary, name: str) -> str:
    """Write the card as Markdown, with a header for the Hugging Face Hub.

    Args:
        folder: folder of the trained model.
        summary: evaluation of the model.
        name: name or address of the model.
    """
    recipe, data = Recipe.from_yaml(folder.recipe), DatasetCard.read(folder.card)
    shows = html.escape(" ".join(data.environment.summary.split()).rstrip("."), quote=False)
    environment, facts = data.environment, summary.provenance
    height, width = environment.frame_size
    score = summary.splits[next(iter(summary.splits))].scores.rows["model"][summary.headline]
    unit = summary.metrics[summary.headline].unit
    command, trained = data.command(recipe.data["path"]), read_metadata(folder.weights)
    return f"""---
library_name: acwm
tags: [world-model, action-conditioned-video, {environment.name}]
---

# {shows}: {height}×{width}, {_shown(score)} {unit}

A world model of `{environment.name}`: from the first frames and actions it predicts the video.

    acwm rollout {name}
    acwm evaluate {name}

## How it was made

- Model: `{recipe.model.name}` with `{recipe.conditioner.name}` on latents of `{recipe.codec.name}`,
  {facts["parameters"] / 1e6:.2f} M trained parameters, stored in bfloat16.
- Data: {data.splits.get("train", 0):,} training episodes, `{command}`
- Training: {facts["training_steps"]:,} steps of {recipe.data["batch_size"]} clips of up to
  {recipe.data["clip_frames"]} frames, {recipe.data["context_frames"]} of them given, seed
  {recipe.training["seed"]}{_hours(trained)}{_start(trained)}.

{_curve(folder.metrics)}
## How good it is

{_episodes(summary)}, with the stored weights and 95 % intervals. `acwm evaluate {name}`
reproduces them.

{_scores(summary)}
{_ceilings(summary)}"""


def _hours(facts: dict[str, Any]) -> str:
    return f", {facts['cpu_seconds'] / 3600:.1f} CPU-hours" if "cpu_seconds" in facts else ""


def _start(facts: dict[str, Any]) -> str:
    if not (start := facts.get("init_from")):
        return ""
    name = html.escape(str(start.get("name")), quote=False).replace("`", "")
    return f"; started from the weights of `{name}`: {start['step']:,} steps{_hours(start)}"


def _curve(metrics: Path) -> str:
    """Table of losses at evenly spaced training steps; empty if no losses were recorded.

    Raises:
        DataError: the file is damaged.
    """
    rows: dict[int, dict[str, str]] = {}
    try:
        text = metrics.read_bytes().decode() if metrics.is_file() else ""
        for row in csv.DictReader(io.StringIO(text, newline="")):
            kept = {name: row[name] for name in SHOWN if row.get(name)}
            rows.setdefault(int(row["step"]) + 1, {}).update(kept)
            if not all(math.isfinite(float(value)) for value in kept.values()):
                raise ValueError("a loss is not finite")
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(
            f"{metrics} is damaged ({type(error).__name__}: {error}): restore or remove it"
        ) from error
    validated = [step for step in rows if "val/loss" in rows[step]]
    if not validated:
        return ""
    spread = range(1, CURVE_POINTS + 1)
    chosen = sorted({validated[(len(validated) * n - 1) // CURVE_POINTS] for n in spread})
    names = [name for name in SHOWN if name in rows[chosen[-1]]]
    lines = [["step", *names], ["---"] * (1 + len(names))]
    lines += [[f"{step:,}", *(_rounded(rows[step].get(n)) for n in names)] for step in chosen]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _rounded(text: str | None) -> str:
    return f"{float(text):.4g}" if text else ""


def _episodes(summary: Summary) -> str:
    counts = {s: each.scores.episodes or each.scores.clips for s, each in summary.splits.items()}
    return " and ".join(f"{n} episodes {SPLITS.get(s, s)}" for s, n in counts.items()).capitalize()


def _scores(summary: Summary) -> str:
    """Table of scores: a row per metric, also of the action response, and a column per split."""
    splits = summary.splits
    lines = [["", *(SPLITS.get(split, split) for split in splits)], ["---"] * (1 + len(splits))]
    for name, info in summary.metrics.items():
        scores = [each.scores.rows["model"].get(name) for each in splits.values()]
        if any(each and each.value is not None for each in scores):
            title = f"{info.title or name}, {info.unit}" if info.unit else info.title or name
            lines.append([title, *(_shown(each) for each in scores)])
    asked = [each.counterfactual for each in splits.values()]
    for name in dict.fromkeys(n for each in asked if each for n in each.rows["model"]):
        cells = (_shown(each.rows["model"].get(name)) if each else "" for each in asked)
        lines.append([f"action {name}", *cells])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _ceilings(summary: Summary) -> str:
    """The headline metric and its bounds, and where the squared error comes from, per split."""
    lines: list[str] = []
    for split, result in summary.splits.items():
        rows = {row: found.get(summary.headline) for row, found in result.scores.rows.items()}
        beside = [f"{short_title(row)} {_shown(rows[row])}" for row in BESIDE if row in rows]
        text = f"{summary.metrics[summary.headline].title} {SPLITS.get(split, split)}: "
        parts = error_shares(result.scores)
        lines.append(f"- {text}{', '.join(beside)}{f'. Approximate {parts}' if parts else ''}.\n")
    return "".join(lines)


def _shown(score: Estimate | None) -> str:
    """Format a score with its interval, if it has one."""
    if score is None or score.value is None:
        return "–"
    value = f"{score.value:.4g}"
    return value if score.low is None else f"{value} [{score.low:.4g}, {score.high:.4g}]"
