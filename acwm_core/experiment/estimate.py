"""How long the rest of an experiment takes, from what was measured before and so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from acwm_core.experiment.config import DEFAULT, Measured
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.states import State
from acwm_core.experiment.steps import KINDS, Kind, Step


@dataclass(frozen=True)
class Estimate:
    """The time that is left.

    Attributes:
        seconds: of the steps for which it is known.
        unknown: how many others there are.
        measured: whether steps of this experiment have told how fast this machine is.
    """

    seconds: float
    unknown: int
    measured: bool


def estimate(
    steps: Sequence[Step],
    states: Mapping[str, State],
    ledger: Ledger,
    measured: Measured,
    *,
    jobs: int = 1,
    cores: int = 1,
) -> Estimate:
    """The time that the steps take that are not done.

    Seconds of the experiment file hold for one core of some machine. As soon as steps of a kind are
    done, all of that kind are taken to be as much faster or slower as these were; without any in
    the file, they take as long as these on average.

    Args:
        steps: all of them.
        states: how far each is.
        ledger: what steps took.
        measured: seconds of the experiment file.
        jobs: trainings and evaluations at once.
        cores: over which a simulation is spread.
    """
    seconds, unknown, from_here = 0.0, 0, False
    for kind in KINDS:
        those = [step for step in steps if step.kind == kind]
        expected = {step.name: expected_seconds(step, measured) for step in those}
        took = {step.name: ledger.seconds_of(step.name) for step in those}
        usual = _typical(expected, took)
        from_here = from_here or any(each is not None for each in took.values())
        for step in those:
            left = 1 - states[step.name].share
            if states[step.name].done:
                continue
            whole = usual.get(step.name)
            if whole is None:
                unknown += kind != "report"
                continue
            seconds += left * whole / _at_once(kind, jobs, cores, took)
    return Estimate(seconds, unknown, from_here)


def _typical(
    expected: Mapping[str, float | None], took: Mapping[str, float | None]
) -> dict[str, float]:
    """What each step of a kind takes, on this machine if any was done here."""
    pairs = [(expected[name], real) for name, real in took.items() if real is not None]
    both = [(wanted, real) for wanted, real in pairs if wanted]
    speed = sum(real for _, real in both) / sum(wanted for wanted, _ in both) if both else 1.0
    mean = fmean(real for _, real in pairs) if pairs else None
    found = {name: mean if each is None else each * speed for name, each in expected.items()}
    return {name: each for name, each in found.items() if each is not None}


def _at_once(kind: Kind, jobs: int, cores: int, took: Mapping[str, float | None]) -> float:
    """By how much the steps of a kind are divided; a measured simulation took all cores already."""
    if kind == "simulate":
        return 1.0 if any(took.values()) else float(cores)
    return float(jobs) if kind in ("train", "evaluate") else 1.0


def expected_seconds(step: Step, measured: Measured) -> float | None:
    """What the whole step takes by the experiment file; None if that does not say."""
    if step.dataset:
        counts = step.dataset.choice.episodes
        each = _lookup(measured.episode, step.dataset.environment)
        return sum(counts) * each if counts and each is not None else None
    if step.run is None:
        return None
    if step.kind == "train":
        each = _lookup(measured.step, Path(step.run.arguments[0]).stem)
        return step.run.max_steps * each if each is not None else None
    environment = step.run.recipe.env
    return _lookup(measured.evaluation, environment.name if environment else DEFAULT)


def _lookup(values: Mapping[str, float], name: str) -> float | None:
    return values.get(name, values.get(DEFAULT))
