"""Whether evaluations may stand beside each other: same environment, test data, protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.results import Summary

SAME_DATA = "evaluate both with the same --data"

Summaries = Mapping[str, Summary]
"""By the run's label."""


def clip_of(result: ClipResult) -> tuple[str, int, int, int]:
    """What makes two results be of the same clip: split, episode, first frame and length."""
    return result.split, result.episode, result.start, result.frames


def refuse_unlike(summaries: Summaries) -> None:
    """Raise if a difference between the runs would not be one between models.

    Raises:
        DataError: other environments, test data or protocols.
    """
    (label, first), *others = summaries.items()
    for other, summary in others:
        for what, fact, remedy in _MUST_AGREE:
            ours, theirs = fact(first), fact(summary)
            if ours != theirs:
                _refuse((label, other), f"{what} ({ours}, {theirs})", remedy)
        ours, theirs = checksums(first), checksums(summary)
        for split in ours.keys() & theirs.keys():
            if ours[split] != theirs[split]:
                hashes = f"{split} {ours[split][:8]}, {theirs[split][:8]}"
                _refuse((label, other), f"on other test data ({hashes})", SAME_DATA)


def _refuse(labels: tuple[str, str], what: str, remedy: str) -> NoReturn:
    raise DataError(f"{' and '.join(labels)} were evaluated {what}: {remedy}")


def warnings_of(summaries: Summaries) -> list[str]:
    """What differs between the evaluations besides the models."""
    found: list[str] = []
    for what, fact in _SHOULD_AGREE:
        values = {label: fact(summary) for label, summary in summaries.items()}
        if len({repr(value) for value in values.values()}) > 1:
            each = ", ".join(f"{label} {value}" for label, value in values.items())
            found.append(f"{what} differ: {each}")
    return found


def checksums(summary: Summary) -> dict[str, str]:
    """SHA-256 of the test data, by split."""
    return summary.provenance["dataset"]["checksums"]


def hashes_of(summary: Summary) -> dict[str, str]:
    """SHA-256 of all that was evaluated: recipe, weights and, by split, test data."""
    parts = {part: summary.provenance[f"{part}_sha256"] for part in ("recipe", "weights")}
    return {**parts, **checksums(summary)}


def estimator_of(summary: Summary) -> str:
    """What states were read with, by its hashes."""
    facts: Mapping[str, str] = summary.provenance.get("estimator") or {}
    return " and ".join(f"{what} {hashed}" for what, hashed in facts.items()) or "none"


def setting(name: str) -> Callable[[Summary], Any]:
    """Reads a setting of the evaluation."""
    return lambda summary: summary.provenance["evaluation"].get(name)


def protocol_of(summary: Summary) -> str:
    """The protocol with all that decides which clips are predicted, as a phrase."""
    chosen = summary.provenance["evaluation"]
    parts = [summary.protocol]
    for name in ("frames", "cuts", "episodes"):
        if chosen.get(name) is not None:
            parts.append(f"{chosen[name]} {name}")
    return ", ".join(parts)


_MUST_AGREE: tuple[tuple[str, Callable[[Summary], Any], str], ...] = (
    ("on other environments", lambda s: s.parts["env"], "there are no pairs of clips"),
    ("by other protocols", lambda s: s.protocol, "evaluate both with the same --protocol"),
)

_SHOULD_AGREE: tuple[tuple[str, Callable[[Summary], Any]], ...] = (
    ("numbers of sampling steps", lambda s: s.provenance["sampling_steps"]),
    ("seeds of the noise", setting("seed")),
    ("estimators of states", estimator_of),
    ("versions of acwm", lambda s: s.provenance["versions"]["acwm"]),
    ("devices", lambda s: s.provenance["device"].split(" ")[0]),
)
