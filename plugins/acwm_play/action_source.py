"""Who acts in a session, and what they want: the person, the behaviour policy or a driver."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from acwm_core.plugins import catalog
from acwm_play import messages
from acwm_play.goal_episode import GoalEpisode
from acwm_play.live_world import LiveWorld
from acwm_play.simulator import TimeStep

PERSON, POLICY = "you", "policy"
"""Who can act in every world; registered drivers act in worlds with tasks."""


class ActionSource:
    """Gives the next action of whoever drives.

    Args:
        tell: sends a message to the page, see `acwm_play.messages.ServerMessage`.

    Attributes:
        driver: who drives: `PERSON`, `POLICY` or the registered name of a driver.
        seq: number of the person's last message with an action.
    """

    def __init__(self, tell: Callable[..., None]) -> None:
        self.driver, self.seq = PERSON, 0
        self._tell = tell
        self._task: str | None = None
        self._episode: GoalEpisode | None = None
        self._values: list[float] | None = None
        self._places: NDArray[np.float64] | None = None
        self._restart_policy = True

    @property
    def over(self) -> bool:
        """Whether a driver has reached its goal, so that nothing happens until the page asks."""
        return self._episode is not None and self._episode.solved

    def hold(self, message: messages.Act | messages.Point) -> None:
        """Note what the person wants, until the next message."""
        self.seq = message.seq
        if isinstance(message, messages.Act):
            self._values, self._places = message.values, None
        else:
            self._places = _places(message.places)

    def hand_to(self, by: str, task: str | None = None) -> None:
        """Let someone else drive; nobody that is unknown."""
        if by in (PERSON, POLICY) or by in catalog().registry("driver"):
            self.stop()
            self.driver, self._task = by, task or self._task

    def begin(self, live: LiveWorld) -> None:
        """A scene has begun; whoever drives begins anew."""
        self.stop()
        self._choose(live)

    def stop(self) -> None:
        """Forget what was wanted and planned."""
        self._values, self._places, self._restart_policy = None, None, True
        if self._episode is not None:
            self._episode.stop()
            self._episode = None
            self._tell("attempt", phase=None)

    async def ready(self, live: LiveWorld, wake: asyncio.Event) -> bool:
        """Whether the next action is known; if not, wait until it is, or until `wake` is set.

        Raises:
            Exception: a driver failed; the person drives again.
        """
        self._choose(live)
        if self._task is None or self.driver in (PERSON, POLICY):
            return True
        if self._episode is None:
            self._episode = GoalEpisode(live, self.driver, self._task, self._tell)
        try:
            return await self._episode.ready(wake)
        except Exception:
            self.hand_to(PERSON)
            raise

    async def act(self, live: LiveWorld) -> TimeStep:
        """Advance the simulator by one frame, after `ready`."""
        if self._episode is not None:
            return await self._episode.act()
        if self.driver == POLICY:
            anew, self._restart_policy = self._restart_policy, False
            return await live.act_by_policy(anew)
        pointing = live.simulator.pointing
        size = live.simulator.card.action.size
        if self._places is not None and pointing is not None and self._places.size == size:
            return await live.act(pointing.action(self._places))
        if self._values is not None and len(self._values) == size:
            return await live.act(np.array(self._values, np.float32))
        return await live.act(await live.simulator.still())

    def _choose(self, live: LiveWorld) -> None:
        """Choose a task of this world for a driver; the person drives if it has none."""
        if self._task not in live.tasks:
            self._task = next(iter(live.tasks), None)
        if self._task is None and self.driver != POLICY:
            self.driver = PERSON


def _places(values: list[list[float]]) -> NDArray[np.float64] | None:
    """Places `[P, 2]`, or None if the values are not places."""
    if not values or any(len(place) != 2 for place in values):
        return None
    return np.clip(np.array(values, np.float64), 0, 1)
