"""Scripted policies of any environment: a script, how much of it is done, noise and bias."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from acwm_core.environment import Environment, Policy
from acwm_core.episode import EpisodeSpec
from acwm_core.errors import RecipeError, suggest
from acwm_core.errors.plugin_code import WrongResultError, numbers
from acwm_core.planning.task import Goal, Task

Script = Literal["solution", "behaviour"]

SCRIPTS: tuple[Script, ...] = ("solution", "behaviour")
"""The task's own solution, and the behaviour policy that made the data, which knows no goal."""

HOLD = 5
"""Actions for which a draw of the noise lasts, so that it moves things and is no trembling."""


@dataclass(frozen=True)
class ScriptedPolicy:
    """A script that is done in part and disturbed.

    With s what means no motion, a what the script wants and h half the range of each dimension, the
    action is ``s + skill · (a − s) + (noise · n + bias · b) · h`` within the bounds; n is drawn
    evenly from [−1, 1] in each dimension and held for `HOLD` actions, b is 1 or −1 in each, drawn
    once for an environment. A skill of 1 is the script, of 0 no motion, below 0 the opposite.

    It looks at the simulator, so its actions are made there and then given to a model.

    Attributes:
        script: one of `SCRIPTS`.
    """

    script: Script
    skill: float = 1.0
    noise: float = 0.0
    bias: float = 0.0

    @property
    def name(self) -> str:
        """As it is asked for, e.g. ``solution,skill=0.7,noise=0.3``."""
        usual = ScriptedPolicy(self.script)
        words = [
            f"{each}={getattr(self, each):g}"
            for each in ("skill", "noise", "bias")
            if getattr(self, each) != getattr(usual, each)
        ]
        return ",".join([self.script, *words])

    def begin(self, environment: Environment, task: Task, goal: Goal) -> Policy:
        """The policy of an episode, which starts where the environment is.

        Raises:
            RecipeError: the task has no solution.
        """
        spec, action = environment.episode_spec, environment.card.action
        solves = self.script == "solution"
        owner, method = (task, "solution") if solves else (environment, "policy")
        if solves:
            act = task.solution(environment, goal, spec.rng("policy"))
        else:
            act = environment.policy(spec.rng("policy"))
        if act is None:
            raise RecipeError(f"the task {task.name!r} has no scripted solution")
        script, rng = act, spec.rng(f"policy:{self.name}")
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        side = EpisodeSpec(environment.card.name).rng("bias").choice([-1.0, 1.0], len(low))
        drawn = (rng.uniform(-1, 1, len(low)) for _ in itertools.count())
        noise = (each for each in drawn for _ in range(HOLD))

        def disturbed() -> np.ndarray:
            still = environment.still_action()
            wanted = numbers(owner, method, script(), len(low)).astype(np.float64)
            if not np.isfinite(wanted).all():
                raise WrongResultError(owner, method, math.nan, "finite numbers")
            pushed = self.noise * next(noise) + self.bias * side
            made = still + self.skill * (wanted - still) + pushed * (high - low) / 2
            return np.clip(made.astype(np.float32), low, high)

        return disturbed


def declared(solvable: bool) -> list[ScriptedPolicy]:
    """The policies that are ranked where nobody names others.

    Args:
        solvable: whether the task has a scripted solution; else all are made of the behaviour.
    """
    if not solvable:
        skills, noises, biases = (1, 0.75, 0.5, 0.25, 0, -0.5), (0, 0.3), (0, 0.15)
        grid = itertools.product(skills, noises, biases)
        return [ScriptedPolicy("behaviour", *each) for each in grid]
    good = itertools.product((1, 0.7, 0.4, 0.2), (0, 0.3), (0, 0.15))
    poor = itertools.product((0, -0.4), (0, 0.3))
    blind = itertools.product((1, 0.5), (0, 0.3))
    return [
        *(ScriptedPolicy("solution", *each) for each in (*good, *poor)),
        *(ScriptedPolicy("behaviour", *each) for each in blind),
    ]


def scripted(text: str) -> ScriptedPolicy:
    """The policy of a name such as ``solution,skill=0.7,noise=0.3,bias=0.15``.

    Raises:
        RecipeError: it is no such name.
    """
    script, *words = text.split(",")
    if script not in SCRIPTS:
        near = suggest(script, [*SCRIPTS, "scripted"])
        raise RecipeError(f"unknown policy {text!r}{near}; one of your own is module:name")
    values: dict[str, float] = {}
    for word in words:
        match = re.fullmatch(r"(skill|noise|bias)=(-?\d*\.?\d+)", word)
        if match is None or match[1] in values or (match[1] == "noise" and float(match[2]) < 0):
            raise RecipeError(
                f"policy {text!r}: {word!r} is none of skill=NUMBER, noise=NUMBER (0 or more) and "
                "bias=NUMBER, each once"
            )
        values[match[1]] = float(match[2])
    return ScriptedPolicy(cast(Script, script), **values)


def solvable(environment: Environment, task: Task, goal: Goal) -> bool:
    """Whether the task has a scripted solution where the environment is."""
    rng = environment.episode_spec.rng("policy")
    return task.solution(environment, goal, rng) is not None
