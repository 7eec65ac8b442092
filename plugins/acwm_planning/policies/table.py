"""Summarises finished episodes as a ranking: scores of policies, and agreement of the judges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from acwm_core.errors import DataError
from acwm_planning.policies.agreement import Scores, agreement, decisions
from acwm_planning.policies.ranking import Agreement, PolicyScores, Ranking
from acwm_planning.resumable import Line, ResumableResults

DECISION = "decision"
"""Used in place of a policy's name, for the choice among action sequences from a start."""

JUDGES = ("estimator", "model")
"""What is compared with the truth: the estimator on true frames, and on the model's frames."""


@dataclass(frozen=True)
class _Judged:
    success: bool
    returns: float


@dataclass(frozen=True)
class PolicyLine:
    """An episode of a policy, as `acwm rank` writes it."""

    policy: str
    seed: int
    loop: str
    truth: _Judged
    estimator: _Judged
    model: _Judged


@dataclass(frozen=True)
class _Branch:
    truth: float
    estimator: float
    model: float


@dataclass(frozen=True)
class DecisionLine:
    """The choice among action sequences from a start, as `acwm rank` writes it."""

    policy: Literal["decision"]
    seed: int
    branches: list[_Branch]


SCORES = ("success", "returns")


def summarise(results: ResumableResults) -> Ranking:
    """The ranking of all policies in a folder, on the episodes that all of them have.

    Raises:
        DataError: they have no episode in common, or the estimator reads no distance for a policy.
    """
    lines, about = results.finished(), results.settings
    by_policy: dict[str, dict[int, Line]] = {}
    for line in lines:
        by_policy.setdefault(line["policy"], {})[line["seed"]] = line
    chosen = [line for _, line in sorted(by_policy.pop(DECISION, {}).items())]
    seeds = sorted(set[int].intersection(*map(set, by_policy.values()))) if by_policy else []
    if not seeds:
        raise DataError(
            f"the policies in {results.folder} have no episode in common: rank all of them on the "
            "same --seeds"
        )
    unread = {name: _unread(of, seeds) for name, of in by_policy.items()}
    blind = [name for name, counts in unread.items() if counts["estimator"] == len(seeds)]
    if blind:
        raise DataError(
            f"the estimator of {about['environment']} cannot read the distance in the true frames "
            f"of {len(blind)} of {len(unread)} policies ({', '.join(blind)[:200]}), so they cannot "
            f"be ranked: improve the estimator, or leave these policies out and use another --out "
            f"than {results.folder}"
        )
    by_judge = {
        (judge, score): np.array(
            [[float(of[n][judge][score]) for n in seeds] for of in by_policy.values()]
        )
        for judge in ("truth", *JUDGES)
        for score in SCORES
    }
    return Ranking(
        environment=about["environment"],
        task=about["task"],
        unit=about["unit"],
        weights=about["weights"],
        episodes=len(seeds),
        policies=_policies(by_policy, seeds, by_judge, unread),
        agreement={judge: _agreement(judge, by_judge) for judge in JUDGES},
        decisions={judge: decisions(*_choices(judge, chosen)) for judge in JUDGES if chosen},
    )


def _policies(
    by_policy: Mapping[str, Mapping[int, Line]],
    seeds: Sequence[int],
    by_judge: Mapping[tuple[str, str], Scores],
    unread: Mapping[str, Mapping[str, int]],
) -> list[PolicyScores]:
    """Scores of the policies, best true score first."""
    means = {which: values.mean(1) for which, values in by_judge.items()}

    def scores(score: str, row: int) -> dict[str, float]:
        return {judge: float(means[judge, score][row]) for judge in ("truth", *JUDGES)}

    policies = [
        PolicyScores(
            name,
            of[seeds[0]]["loop"],
            scores("success", row),
            scores("returns", row),
            {judge: count for judge, count in unread[name].items() if count},
        )
        for row, (name, of) in enumerate(by_policy.items())
    ]
    return sorted(policies, key=lambda scores: (-scores.success["truth"], -scores.returns["truth"]))


def _unread(lines: Mapping[int, Line], seeds: Sequence[int]) -> dict[str, int]:
    """For each judge, the number of episodes in which it could not read any distance."""
    return {
        judge: sum(bool(lines[seed][judge].get("unread")) for seed in seeds) for judge in JUDGES
    }


def _agreement(judge: str, by_judge: Mapping[tuple[str, str], Scores]) -> dict[str, Agreement]:
    return {score: agreement(by_judge[judge, score], by_judge["truth", score]) for score in SCORES}


def _choices(judge: str, chosen: Sequence[Line]) -> tuple[list[Any], list[Any]]:
    def returns(name: str) -> list[Any]:
        return [np.array([branch[name] for branch in line["branches"]]) for line in chosen]

    return returns(judge), returns("truth")
