"""The line about several draws of each clip."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acwm_core.evaluation.results import Estimate, Summary

COVERAGES = {"coverage_50": 50, "coverage_80": 80, "coverage_95": 95}
"""Metrics of intervals, and the percentage that each should cover."""


def draws_phrase(summary: Summary, split: str) -> str:
    """How good the draws of a split are, alone and together; empty if one was asked for.

    ``8 draws: PSNR 24.8 dB of one, 26.1 of their mean, 26.4 of the best; energy score …``.
    """
    if summary.provenance["evaluation"].get("samples", 1) == 1:
        return ""
    rows, info = summary.splits[split].scores.rows, summary.metrics[summary.headline]
    one, mean, best = (
        _shown(rows[row].get(summary.headline))
        for row in ("model", "mean_of_draws", "best_of_draws")
    )
    number = summary.provenance["draws"]
    unit = f" {info.unit}" if info.unit else ""
    parts = [f"{info.title} {one}{unit} of one, {mean} of their mean, {best} of the best"]
    model = rows["model"]
    if score := model.get("energy_score"):
        parts.append(f"energy score {_shown(score)}")
    if ratio := model.get("spread_skill"):
        parts.append(f"spread {_shown(ratio)} of the error of their mean (1 is calibrated)")
    known = {share: model[name] for name, share in COVERAGES.items() if name in model}
    if any(each.value is not None for each in known.values()):
        found = " / ".join(_percent(each) for each in known.values())
        asked = " / ".join(map(str, known))
        parts.append(f"intervals of {asked} % cover {found} % of the positions")
    what = f"{number} draws" if number > 1 else "the model is deterministic; its one prediction"
    return f"{what}: {'; '.join(parts)}"


def _shown(estimate: Estimate | None) -> str:
    value = estimate.value if estimate else None
    return "–" if value is None else f"{value:.3g}".replace("inf", "∞")


def _percent(estimate: Estimate) -> str:
    return "–" if estimate.value is None else f"{100 * estimate.value:.0f}"
