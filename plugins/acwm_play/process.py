"""Runs a simulator in its own process, where it has the main thread, which rendering needs."""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal
from acwm_core.errors import PluginError, RecipeError, sentence
from acwm_play.layout import Pointing, physics_of
from acwm_play.simulator import Scene, Simulator, TaskProgress, TimeStep

PATIENCE = 5.0
"""Seconds to wait for a process to end before it is killed."""


class SimulatorProcess:
    """A `Simulator` in another process; create it with `started`.

    Errors in that process are raised here as a `RecipeError` or a `PluginError`.

    Attributes:
        card: card of the environment, with the frame size.
        pointing: the map from places in the picture to actions, if there is one.
        alive: whether the process still answers.
    """

    card: EnvironmentCard
    pointing: Pointing | None

    def __init__(self, environment: str, size: tuple[int, int]) -> None:
        self._name = environment
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_simulate, args=(theirs, environment, size), daemon=True
        )
        self._thread = ThreadPoolExecutor(1, f"acwm-play-{environment}")
        self._theirs, self.alive = theirs, True

    @classmethod
    async def started(cls, environment: str, size: tuple[int, int]) -> SimulatorProcess:
        """Start the process and wait until it is ready.

        Raises:
            AcwmError: the environment cannot be created.
        """
        made = cls(environment, size)
        try:
            made.card, made.pointing = await made._do(made._begin)
        except BaseException:
            await asyncio.shield(made.close())
            raise
        return made

    async def start(self, scene: Scene, frames: int) -> list[TimeStep]:
        """See `Simulator.start`."""
        return await self._do(self._ask, "start", scene, frames)

    async def step(self, action: NDArray[np.float32]) -> TimeStep:
        """See `Simulator.step`."""
        return await self._do(self._ask, "step", action)

    async def step_by_policy(self, anew: bool) -> TimeStep:
        """See `Simulator.step_by_policy`."""
        return await self._do(self._ask, "step_by_policy", anew)

    async def aim(self, task: str) -> tuple[Goal, TaskProgress]:
        """See `Simulator.aim`."""
        return await self._do(self._ask, "aim", task)

    async def still(self) -> NDArray[np.float32]:
        """See `Simulator.still`."""
        return await self._do(self._ask, "still")

    async def close(self) -> None:
        """End the process."""
        self.alive = False
        self._connection.close()  # the process ends when its connection is closed
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(None, self._end)
        self._thread.shutdown(wait=False)

    async def _do(self, work: Any, *args: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work, *args)

    def _begin(self) -> Any:
        self._process.start()
        self._theirs.close()
        return self._answer()

    def _ask(self, name: str, *args: Any) -> Any:
        try:
            self._connection.send((name, args))
        except OSError as error:
            raise self._gone() from error
        return self._answer()

    def _answer(self) -> Any:
        try:
            good, answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if not good:
            kind, text = answer
            raise kind(text)
        return answer

    def _gone(self) -> PluginError:
        self.alive = False
        return PluginError(f"the simulator of {self._name} has ended: begin a new scene")

    def _end(self) -> None:
        if self._process.pid is not None:
            self._process.join(PATIENCE)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()


def _simulate(connection: Connection, environment: str, size: tuple[int, int]) -> None:
    """Main function of the process: answers requests until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the server, which ends this
    made: list[Simulator] = []

    def begin() -> tuple[EnvironmentCard, Pointing | None]:
        made.append(Simulator(environment, size))
        return made[0].card, Pointing.found(made[0], physics_of(environment))

    try:
        connection.send(_answered(begin))
        while made:
            name, args = connection.recv()
            connection.send(_answered(getattr(made[0], name), *args))
    except (EOFError, OSError):  # the server has closed the connection, or died
        pass
    finally:
        for simulator in made:
            simulator.close()


def _answered(work: Any, *args: Any) -> tuple[bool, Any]:
    """The result, or class and text of an error; some errors cannot be sent between processes."""
    try:
        return True, work(*args)
    except Exception as error:
        kind = RecipeError if isinstance(error, RecipeError) else PluginError
        return False, (kind, sentence(error))
