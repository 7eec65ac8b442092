"""`Ranking`: how well a model ranks policies, as result files hold it."""

from __future__ import annotations

from dataclasses import dataclass, field

from acwm_core.statistics import Estimate

FOLDER, FILE = "ranking", "ranking.json"
"""Those of a task lie in ``RUN/ranking/TASK/ranking.json``."""


@dataclass(frozen=True)
class PolicyScores:
    """One policy, by who judged it: ``truth``, ``estimator`` (of true pictures), ``model``."""

    policy: str
    loop: str  # ``"closed"`` if it saw what the model predicted, ``"open"`` if it did not
    success: dict[str, float]  # share of episodes
    returns: dict[str, float]  # mean of minus the sum of distances until success
    # episodes in which no frame told the distance, so that it stayed as at the start
    unread: dict[str, int] = field(default_factory=dict[str, int])


@dataclass(frozen=True)
class Agreement:
    """How far a judge's scores of policies agree with the truth; undefined ones are None."""

    pearson: Estimate
    spearman: Estimate
    kendall: Estimate
    mmrv: Estimate  # mean maximum rank violation, in the unit of the score
    optimism: Estimate  # judge minus truth, mean over policies and episodes


@dataclass(frozen=True)
class Decisions:
    """Choices among the action sequences of one start, in the task's unit per action."""

    starts: int
    regret: Estimate  # truth of the best sequence minus that of the judge's choice
    chance: Estimate  # the same of choosing at random
    gain: Estimate  # chance minus regret, start by start


@dataclass(frozen=True)
class Ranking:
    """``ranking.json``."""

    environment: str
    task: str
    unit: str  # of distances
    weights: str | None  # SHA-256 of the model's file
    episodes: int  # of each policy
    policies: list[PolicyScores]  # the truly best first
    agreement: dict[str, dict[str, Agreement]]  # by judge, and ``success`` or ``returns``
    decisions: dict[str, Decisions]  # by judge
