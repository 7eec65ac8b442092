"""Scripted policies for any environment: a script with a skill level, noise and bias."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import Goal, Task
from acwm_core.errors import RecipeError, suggest
from acwm_planning.scripts import NoSolutionError, script

ScriptName = Literal["solution", "behaviour"]

SCRIPTS: tuple[ScriptName, ...] = ("solution", "behaviour")
"""The task's own solution; and the behaviour policy of the data, which does not know the goal."""

HOLD = 5
"""Number of actions for which a noise sample is held, so that it moves things, not just jitters."""


@dataclass(frozen=True)
class ScriptedPolicy:
    """A script that is followed only in part, and disturbed.

    The action is ``s + skill · (a − s) + (noise · n + bias · b) · h``, clipped to the bounds. Here
    s is the action that means no motion, a the script's action, and h half the range of each
    dimension. In each dimension, n is uniform in [−1, 1] and held for `HOLD` actions, and b is 1 or
    −1, samples once per environment. A skill of 1 follows the script, 0 means no motion, and a
    negative skill does the opposite.

    The script looks at the simulator, so its actions are computed there and then given to a model.

    Attributes:
        script: one of `SCRIPTS`.
    """

    script: ScriptName
    skill: float = 1.0
    noise: float = 0.0
    bias: float = 0.0

    @property
    def name(self) -> str:
        """The name by which it is requested, e.g. ``solution,skill=0.7,noise=0.3``."""
        default = ScriptedPolicy(self.script)
        words = [
            f"{name}={getattr(self, name):g}"
            for name in ("skill", "noise", "bias")
            if getattr(self, name) != getattr(default, name)
        ]
        return ",".join([self.script, *words])

    def begin(self, environment: Environment, task: Task, goal: Goal) -> Policy:
        """Create the policy of an episode that starts at the environment's current state.

        Raises:
            NoSolutionError: the task has no solution.
        """
        spec, action = environment.episode_spec, environment.card.action
        solves = self.script == "solution"
        act = script(environment, task, goal, solves=solves, bounded=False)
        rng = spec.rng(f"policy:{self.name}")
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        side = EpisodeSpec(environment.card.name).rng("bias").choice([-1.0, 1.0], len(low))
        samples = (rng.uniform(-1, 1, len(low)) for _ in itertools.count())
        noise = (sample for sample in samples for _ in range(HOLD))

        def disturbed() -> np.ndarray:
            still = environment.still_action()
            intended = act().astype(np.float64)
            pushed = self.noise * next(noise) + self.bias * side
            raw = still + self.skill * (intended - still) + pushed * (high - low) / 2
            return np.clip(raw.astype(np.float32), low, high)

        return disturbed


def built_in_policies(solvable: bool) -> list[ScriptedPolicy]:
    """The policies that are ranked by default.

    Args:
        solvable: whether the task has a scripted solution; if not, all use the behaviour policy.
    """
    if not solvable:
        skills, noises, biases = (1, 0.75, 0.5, 0.25, 0, -0.5), (0, 0.3), (0, 0.15)
        grid = itertools.product(skills, noises, biases)
        return [ScriptedPolicy("behaviour", *levels) for levels in grid]
    good = itertools.product((1, 0.7, 0.4, 0.2), (0, 0.3), (0, 0.15))
    poor = itertools.product((0, -0.4), (0, 0.3))
    blind = itertools.product((1, 0.5), (0, 0.3))
    return [
        *(ScriptedPolicy("solution", *levels) for levels in (*good, *poor)),
        *(ScriptedPolicy("behaviour", *levels) for levels in blind),
    ]


def parse_policy(text: str) -> ScriptedPolicy:
    """Parse a name such as ``solution,skill=0.7,noise=0.3,bias=0.15``.

    Raises:
        RecipeError: the name is invalid.
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
    return ScriptedPolicy(cast(ScriptName, script), **values)


def is_solvable(environment: Environment, task: Task, goal: Goal) -> bool:
    """Whether the task has a scripted solution from the environment's current state."""
    try:
        script(environment, task, goal, solves=True)
    except NoSolutionError:
        return False
    return True
