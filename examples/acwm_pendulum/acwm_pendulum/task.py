"""The task: a goal, the distance of a state from it, and a script that reaches it."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task
from acwm_pendulum.pendulum import GRAVITY, MASS, MAX_TORQUE, Pendulum


class Hold(Task):
    """Bring the bob to an angle and hold it there against gravity, at rest."""

    name = "hold"
    summary = "the bob within 3° of the goal's angle"
    unit = "rad"
    tolerance = np.radians(3)
    max_steps = 63

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Sample an angle at which the motor can hold the bob."""
        pendulum = cast(Pendulum, environment)
        most = np.arcsin(0.6 * MAX_TORQUE / (MASS * GRAVITY * pendulum.length))
        pendulum.motion = np.array([rng.uniform(-most, most), 0.0])
        return Goal.now(pendulum)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Absolute difference of the angles in each frame, `[T]`, in radians."""
        gap = seen.states["angle"] - goal.state["angle"]
        return np.abs((gap + np.pi) % (2 * np.pi) - np.pi)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Compensate gravity, pull towards the goal and brake."""
        pendulum, wanted = cast(Pendulum, environment), float(goal.state["angle"])

        def act() -> NDArray[np.float64]:
            angle, velocity = pendulum.motion
            weight = MASS * GRAVITY * pendulum.length * np.sin(wanted)
            torque = weight + 6.0 * (wanted - angle) - 3.0 * velocity
            return np.clip([torque], -MAX_TORQUE, MAX_TORQUE)

        return act


HOLD = Hold()
