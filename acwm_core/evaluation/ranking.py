"""`Ranking`: how well a model ranks policies, as result files hold it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from acwm_core.evaluation.results import write_json
from acwm_core.statistics import Estimate
from acwm_core.untrusted import check_folder, read_json

FOLDER, FILE = "ranking", "ranking.json"
"""Those of a task lie in ``RUN/ranking/TASK/ranking.json``."""


@dataclass(frozen=True)
class PolicyScores:
    """One policy, by who judged it: ``truth``, ``estimator`` (of true pictures), ``model``.

    Attributes:
        policy: its name.
        loop: ``"closed"`` if it saw what the model predicted, ``"open"`` if its actions were given.
        success: share of episodes.
        returns: mean return, minus the sum of distances until success.
    """

    policy: str
    loop: str
    success: dict[str, float]
    returns: dict[str, float]


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
    """Choices among the action sequences of one start, in the task's unit per action.

    Attributes:
        starts: how many choices.
        regret: truth of the best sequence minus that of the judge's choice.
        chance: the same of choosing at random.
        gain: chance minus regret, start by start.
    """

    starts: int
    regret: Estimate
    chance: Estimate
    gain: Estimate


@dataclass(frozen=True)
class Ranking:
    """``ranking.json``."""

    environment: str
    task: str
    unit: str  # of distances
    weights: str | None  # SHA-256 of the model's
    episodes: int  # of each policy
    policies: list[PolicyScores]
    agreement: dict[str, dict[str, Agreement]]  # by judge, and ``success`` or ``returns``
    decisions: dict[str, Decisions]  # by judge

    def write(self, folder: Path) -> None:
        """Write it into a folder."""
        write_json(folder / FILE, self)


def read_rankings(run: Path) -> Iterator[Ranking]:
    """Those of a run folder, in order of their tasks.

    Raises:
        DataError: one is damaged.
    """
    check_folder(run)
    for path in sorted((run / FOLDER).glob(f"*/{FILE}")):
        yield read_json(path, Ranking, "a ranking of policies")
