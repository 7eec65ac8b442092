"""Runs a simulator in its own process, where it has the main thread, which rendering needs."""

from __future__ import annotations

import asyncio
import signal
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal
from acwm_core.errors import PluginError, RecipeError, sentence
from acwm_core.executors import worker_context
from acwm_play.layout import Pointing, physics_of
from acwm_play.simulator import SCENES, SceneSpec, Simulator, TaskProgress, TimeStep

PATIENCE = 5.0
"""Seconds to wait for a process to end before it is killed."""


class SimulatorProcess:
    """A `Simulator` in another process; create it with `launch`.

    Errors in that process are raised here as a `RecipeError` or a `PluginError`.

    Attributes:
        card: card of the environment, with the frame size.
        pointing: the map from places in the picture to actions, if there is one.
        alive: whether the process still answers.
    """

    scenes = SCENES
    card: EnvironmentCard
    pointing: Pointing | None

    def __init__(self, environment: str, size: tuple[int, int]) -> None:
        self._name = environment
        context = worker_context(__name__)
        self._connection, other_end = context.Pipe()
        self._process = context.Process(
            target=_simulate, args=(other_end, environment, size), daemon=True
        )
        self._thread = ThreadPoolExecutor(1, f"acwm-play-{environment}")
        self._other_end, self.alive = other_end, True

    @classmethod
    async def launch(cls, environment: str, size: tuple[int, int]) -> SimulatorProcess:
        """Start the process and wait until it is ready."""
        process = cls(environment, size)
        try:
            process.card, process.pointing = await process._do(process._begin)
        except BaseException:
            await asyncio.shield(process.close())
            raise
        return process

    async def start(self, scene: SceneSpec, frames: int) -> list[TimeStep]:
        """See `Simulator.start`."""
        return await self._do(self._request, "start", scene, frames)

    async def step(self, action: NDArray[np.float32]) -> TimeStep:
        """See `Simulator.step`."""
        return await self._do(self._request, "step", action)

    async def step_by_policy(self, anew: bool) -> TimeStep:
        """See `Simulator.step_by_policy`."""
        return await self._do(self._request, "step_by_policy", anew)

    async def aim(self, task: str) -> tuple[Goal, TaskProgress]:
        """See `Simulator.aim`."""
        return await self._do(self._request, "aim", task)

    async def still(self) -> NDArray[np.float32]:
        """See `Simulator.still`."""
        return await self._do(self._request, "still")

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
        self._other_end.close()
        return self._receive()

    def _request(self, name: str, *args: Any) -> Any:
        try:
            self._connection.send((name, args))
        except OSError as error:
            raise self._ended_error() from error
        return self._receive()

    def _receive(self) -> Any:
        try:
            good, answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._ended_error() from error
        if not good:
            kind, text = answer
            raise kind(text)
        return answer

    def _ended_error(self) -> PluginError:
        self.alive = False
        if not hasattr(self, "card"):  # another scene would end alike
            self._process.join(PATIENCE)
            code = self._process.exitcode
            return PluginError(
                f"the simulator of {self._name} does not start (exit code {code}): run `acwm "
                "doctor` to see its output"
            )
        return PluginError(f"the simulator of {self._name} has ended: start a new scene")

    def _end(self) -> None:
        if self._process.pid is not None:
            self._process.join(PATIENCE)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()


def _simulate(connection: Connection, environment: str, size: tuple[int, int]) -> None:
    """Main function of the process: answers requests until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the server, which ends this
    simulators: list[Simulator] = []  # none if it cannot be created

    def begin() -> tuple[EnvironmentCard, Pointing | None]:
        simulators.append(Simulator(environment, size))
        return simulators[0].card, Pointing.fit(simulators[0], physics_of(environment))

    try:
        connection.send(_answer(begin))
        while simulators:
            name, args = connection.recv()
            connection.send(_answer(getattr(simulators[0], name), *args))
    except (EOFError, OSError):  # the server has closed the connection, or died
        pass
    finally:
        for simulator in simulators:
            simulator.close()


def _answer(work: Any, *args: Any) -> tuple[bool, Any]:
    """The result, or class and text of an error; some errors cannot be sent between processes."""
    try:
        return True, work(*args)
    except Exception as error:
        kind = RecipeError if isinstance(error, RecipeError) else PluginError
        return False, (kind, sentence(error))
