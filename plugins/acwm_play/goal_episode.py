"""A driver's attempt at a task: the goal, its decisions, and the actions that it has planned."""

from __future__ import annotations

import asyncio
import base64
import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.task import Goal
from acwm_core.errors import AcwmError, PluginError, check_shape, noting
from acwm_play.driver import Driver
from acwm_play.live_world import LiveWorld
from acwm_play.simulator import TimeStep

Phase = Literal["starting", "planning", "acting", "solved"]
"""What an attempt is doing: `starting` draws the goal and loads the driver."""

Action = NDArray[np.float32]


class StoppedError(AcwmError):
    """Nobody waits for a decision any more."""


class GoalEpisode:
    """Decides in a thread, while the simulator waits, until the goal is reached.

    Args:
        live: where it acts.
        driver: registered name of the driver.
        task: name of one of its tasks.
        tell: sends a message to the page, see `acwm_play.messages.ServerMessage`.

    Attributes:
        solved: whether the goal has been reached.
    """

    def __init__(self, live: LiveWorld, driver: str, task: str, tell: Callable[..., None]) -> None:
        self._live, self._name, self._task, self._tell = live, driver, task, tell
        self._driver: Driver | None = None
        self._plan: deque[Action] = deque()
        self._decision: asyncio.Task[None] | None = None
        self._stopped = threading.Event()
        self.solved = False
        self._seconds: float | None = None
        self._decisions = 0

    async def ready(self, wake: asyncio.Event) -> bool:
        """Whether the next action is known; if not, wait until it is, or until `wake` is set."""
        if self.solved or self._plan:
            return True
        decision = self._decision = self._decision or self._start_decision()
        wake.clear()
        waking = asyncio.create_task(wake.wait())
        try:
            await asyncio.wait({decision, waking}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waking.cancel()
        if decision.done() and not decision.cancelled():
            self._decision = None
            decision.result()
        return False

    async def act(self) -> TimeStep:
        """Take the next action; hold still for the rest of a latent frame in which it is solved."""
        still = self.solved or not self._plan
        action = await self._live.simulator.still() if still else self._plan.popleft()
        time_step = await self._live.act(action)
        if time_step.progress is not None and time_step.progress.solved and not self.solved:
            self._finish()
        return time_step

    def stop(self) -> None:
        """Give up: a decision in progress ends with the driver's next look at its check."""
        self._stopped.set()
        if self._decision is not None:
            self._decision.cancel()

    def _start_decision(self) -> asyncio.Task[None]:
        decision = asyncio.create_task(self._decide())
        # An error that comes just when it is stopped is nobody's.
        decision.add_done_callback(lambda done: done.cancelled() or done.exception())
        return decision

    async def _decide(self) -> None:
        """Plan the next actions; at first, set the goal."""
        simulator, run = self._live.simulator, self._live.workers.run
        if self._driver is None:
            self._tell_phase("starting")
            goal, progress = await simulator.aim(self._task)
            self._tell("goal", **_picture(goal), task=self._task, **dataclasses.asdict(progress))
            if progress.solved:
                self._finish()
                return
            still = await simulator.still()
            self._driver = await run("driver", self._create_driver, goal, still)
        self._tell_phase("planning")
        recent = [*self._live.recent]
        frames = [time_step.frame for time_step in recent]
        actions = [time_step.action for time_step in recent[1:]]
        plan, self._seconds = await run("driver", self._ask_driver, self._driver, frames, actions)
        self._plan.extend(plan)
        self._decisions += 1
        self._tell_phase("acting")

    def _create_driver(self, goal: Goal, still: Action) -> Driver:
        live = self._live
        self._check()
        task, card = live.tasks[self._task], live.simulator.card
        driver = live.workers.driver(self._name, live.world, card, task)
        with noting(f"when driver {self._name!r} begins", driver):
            driver.begin(goal, still, live.scene.index)
        return driver

    def _ask_driver(
        self, driver: Driver, frames: Sequence[NDArray[np.uint8]], actions: Sequence[Action]
    ) -> tuple[NDArray[np.float32], float]:
        """The next actions `[n, A]`, and how many seconds the decision took."""
        self._check()
        start = time.monotonic()
        with noting(f"while driver {self._name!r} acts", driver):
            planned = np.asarray(driver.act(frames, actions, self._check), np.float32)
            check_shape(driver, "act", planned, -1, self._live.simulator.card.action.size)
            if not len(planned):
                raise PluginError(f"{type(driver).__name__}.act gives no action")
        return planned, time.monotonic() - start

    def _check(self) -> None:
        if self._stopped.is_set():
            raise StoppedError("this decision was cancelled")

    def _finish(self) -> None:
        self.solved = True
        self._plan.clear()
        self._tell_phase("solved")

    def _tell_phase(self, phase: Phase) -> None:
        if self._stopped.is_set():
            return
        facts: dict[str, Any] = {"took": self._seconds, "decisions": self._decisions}
        self._tell("attempt", phase=phase, task=self._task, **facts)


def _picture(goal: Goal) -> dict[str, Any]:
    """The picture of a goal: its size, and its pixels as text."""
    pixels = np.ascontiguousarray(goal.frame).tobytes()
    return {"size": goal.frame.shape[:2], "pixels": base64.b64encode(pixels).decode()}
