"""`Ranking`: how well a model ranks policies, as stored in result files."""

from __future__ import annotations

from dataclasses import dataclass, field

from acwm_core.evaluation.statistics import Estimate

RANKING_FOLDER, RANKING_FILE = "ranking", "ranking.json"
"""The result of a task is stored in ``RUN/ranking/TASK/ranking.json``."""


@dataclass(frozen=True)
class PolicyScores:
    """One policy's scores by judge: ``truth``, ``estimator`` (on true frames) or ``model``."""

    policy: str
    loop: str  # ``"closed"`` if the policy saw the model's predictions, else ``"open"``
    success: dict[str, float]  # share of episodes
    returns: dict[str, float]  # mean over episodes of minus the sum of distances until success
    # episodes in which no frame showed the distance, so that it stayed as at the start
    unread: dict[str, int] = field(default_factory=dict[str, int])


@dataclass(frozen=True)
class Agreement:
    """How well a judge's scores of policies agree with the truth; undefined values are None."""

    pearson: Estimate
    spearman: Estimate
    kendall: Estimate
    mmrv: Estimate  # mean maximum rank violation, in the unit of the score
    optimism: Estimate  # judge minus truth, mean over policies and episodes


@dataclass(frozen=True)
class Decisions:
    """Choices among the action sequences of one start, in the task's unit per action."""

    starts: int  # number of starts
    regret: Estimate  # true score of the best sequence minus that of the judge's choice
    chance: Estimate  # the same for a random choice
    gain: Estimate  # chance minus regret, start by start


@dataclass(frozen=True)
class Ranking:
    """``ranking.json``."""

    environment: str
    task: str
    unit: str  # unit of distances
    weights: str | None  # SHA-256 of the model's file
    episodes: int  # number of episodes of each policy
    policies: list[PolicyScores]  # the best by the truth first
    agreement: dict[str, dict[str, Agreement]]  # by judge, then by ``success`` or ``returns``
    decisions: dict[str, Decisions]  # by judge
