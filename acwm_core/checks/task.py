"""Checks of an environment's tasks: what planners, rankings and rewards require of them."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from acwm_core.checks.result import (
    CheckResult,
    NotTried,
    expect,
    expect_equal,
    expect_is_a,
    run_checks,
)
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.env.task import Task, TaskEnvironment, observed
from acwm_core.plugins import catalog


def check_task(name: str) -> Iterator[CheckResult]:
    """Check a single registered task against the contract of `acwm_core.env.task.Task`.

    Args:
        name: ``ENVIRONMENT.TASK``.
    """
    catalog().component("task", name)
    environment, _, task = name.partition(".")
    checks = TaskChecks(environment)
    checks.only = task
    return run_checks(checks)


class TaskChecks(EnvironmentTrial):
    """Checks of every task of the environment, or of the one named `only`, on one episode."""

    only: str | None = None

    @functools.cached_property
    def tasks(self) -> dict[str, TaskEnvironment]:
        """The tasks by name; those of a class are not known."""
        if self.name is None:
            raise NotTried("a class has no tasks: give its registered name")
        component = catalog().component("environment", self.name)
        names = [name for name in component.tasks if self.only in (None, name)]
        if not names:
            raise NotTried("it has no tasks")
        tasks = {name: component.load_task(name) for name in names}
        for name, task in tasks.items():
            expect_is_a(task, Task)
            expect_equal(f"the name of task {name!r} is", task.name, name)
        return {name: TaskEnvironment(self.environment, task) for name, task in tasks.items()}

    def tasks_begin_unsolved(self) -> None:
        """Draw the same goal for the same episode, not yet reached, and start as without a task."""
        for name, env in self.tasks.items():
            options = {"spec": self.spec()}
            frame, info = env.reset(options=options)
            first, _ = env.goal, env.reset(options={"spec": self.spec(index=1)})
            _, again = env.reset(options=options)
            pairs = zip(first.state.values(), again["goal"].state.values(), strict=True)
            same = all(np.array_equal(*pair) for pair in pairs)
            expect(same, f"task {name!r} draws another goal for the same episode")
            expect(not info["success"], f"task {name!r} is solved at the start")
            usual = np.array_equal(frame, self.beginning.video[0])
            expect(usual, f"task {name!r} leaves the environment elsewhere than `reset`")

    def goals_solve_their_tasks(self) -> None:
        """Have distance 0 and success in the goal, and show the goal in a frame."""
        for name, env in self.tasks.items():
            _, info = env.reset(options={"spec": self.spec()})
            goal, size = env.goal, env.environment.frame_size
            expect_equal(f"the picture of task {name!r} is", goal.frame.shape, (*size, 3))
            seen = observed([{"state": goal.state, "mask": goal.mask}])
            expect(env.task.distance(seen, goal) == 0, f"the goal of {name!r} is not at distance 0")
            expect(env.task.success(seen, goal), f"task {name!r} is not solved in its own goal")
            expect(info["distance"] > 0, f"the start of task {name!r} is at distance 0")

    def solutions_approach_goals(self) -> None:
        """Get closer to the goal with the scripted solution, if a task provides one."""
        solutions = 0
        for name, env in self.tasks.items():
            _, info = env.reset(options={"spec": self.spec()})
            start = info["distance"]
            act = env.task.solution(env.environment, env.goal, self.spec().rng("solution"))
            if act is None:
                continue
            solutions += 1
            for _ in range(env.task.max_steps):
                _, _, success, _, info = env.step(np.asarray(act(), np.float32))
                if success:
                    break
            what = f"the solution of {name!r} leads from {start:.3g} to {info['distance']:.3g}"
            expect(info["distance"] < start, what)
        if not solutions:
            raise NotTried("no task has a scripted solution")
