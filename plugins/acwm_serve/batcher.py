"""Requests of all clients wait in one bounded queue, from which one thread computes batches."""

from __future__ import annotations

import asyncio
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from acwm_core.errors import AcwmError, sentence
from acwm_serve.engine import Answer, Engine, Running, Start, Step
from acwm_serve.metrics import Metrics
from acwm_serve.plans import PlanRequest

GATHER = 0.002
"""Seconds to wait after a request for those of other clients, which come at the same time."""


class BusyError(AcwmError):
    """Too many requests wait, or one has waited too long. Nothing was computed for it."""


@dataclass(eq=False)
class _Request:
    work: Start | Step | PlanRequest  # what is still to be computed
    done: list[Answer] = field(default_factory=list[Answer])  # of the latent frames before
    answer: asyncio.Future[Any] = field(default_factory=lambda: asyncio.Future[Any]())


class Batcher:
    """Answers requests in the order in which they come, as many at once as wait.

    Args:
        engine: computes.
        metrics: counts.
        queue: most requests that wait.
        batch: most requests that are computed at once.
        timeout: seconds that a request may wait before it is computed.
    """

    def __init__(
        self, engine: Engine, metrics: Metrics, *, queue: int, batch: int, timeout: float
    ) -> None:
        self._engine, self._metrics = engine, metrics
        self._queue, self._batch, self._timeout = queue, batch, timeout
        self._waiting: deque[_Request] = deque()
        self._more = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "acwm-serve-model")
        self._loop: asyncio.Task[None] | None = None

    @property
    def alive(self) -> bool:
        """Whether requests are being answered."""
        return self._loop is not None and not self._loop.done()

    def begin(self) -> None:
        """Answer requests from now on."""
        self._loop = asyncio.create_task(self._run())

    async def start(self, start: Start) -> tuple[Running, Answer]:
        """Begin a video.

        Raises:
            BusyError: the queue is full, or the request has waited too long.
        """
        return await self._ask(start)

    async def step(self, step: Step) -> list[Answer]:
        """Move a video; an answer for each latent frame.

        Raises:
            BusyError: as for `start`; the video has not moved.
        """
        return await self._ask(step)

    async def plan(self, request: PlanRequest) -> Answer:
        """The next actions towards a goal.

        Raises:
            BusyError: as for `start`.
        """
        return await self._ask(request)

    async def close(self) -> None:
        """Stop, once the current batch is computed."""
        if self._loop is not None:
            self._loop.cancel()
            await asyncio.gather(self._loop, return_exceptions=True)
        for request in self._waiting:
            request.answer.cancel()
        self._thread.shutdown(wait=True, cancel_futures=True)

    async def _ask(self, work: Start | Step | PlanRequest) -> Any:
        if len(self._waiting) >= self._queue:
            raise BusyError(f"{self._queue} requests wait already: send this one again later")
        request = _Request(work)
        self._waiting.append(request)
        self._metrics.waiting.set(len(self._waiting))
        self._more.set()
        await asyncio.wait({request.answer}, timeout=self._timeout)
        if request in self._waiting and not request.done:
            self._waiting.remove(request)
            raise BusyError(
                f"the request has waited for {self._timeout:g} s: send it again later, or run the "
                "server on a faster machine"
            )
        return await request.answer

    async def _run(self) -> None:
        while True:
            self._more.clear()
            if not self._waiting:
                await self._more.wait()
            await asyncio.sleep(GATHER)
            count = min(len(self._waiting), self._batch)
            batch = [self._waiting.popleft() for _ in range(count)]
            self._metrics.waiting.set(len(self._waiting))
            loop = asyncio.get_running_loop()
            for kind in (Start, Step, PlanRequest):
                group = [request for request in batch if isinstance(request.work, kind)]
                if group:
                    await loop.run_in_executor(self._thread, self._compute, group, loop)

    def _compute(self, group: list[_Request], loop: asyncio.AbstractEventLoop) -> None:
        """Compute requests of one kind, in the thread."""
        works: Any = [request.work for request in group]
        compute: Any = {
            Start: self._engine.start,
            Step: self._engine.step,
            PlanRequest: self._engine.plan,
        }[type(works[0])]
        self._metrics.batches.observe(len(group))
        try:
            results: list[Any] = compute(works)
        except Exception as error:  # whatever a component raises: the server goes on
            results = [AcwmError(sentence(error))] * len(group)
        for request, result in zip(group, results, strict=True):
            loop.call_soon_threadsafe(self._settle, request, result)

    def _settle(self, request: _Request, result: Any) -> None:
        """Give a client its answer, or let its next latent frame wait for its turn."""
        if request.answer.done():  # nobody waits for it any more
            return
        if isinstance(result, AcwmError):
            request.answer.set_exception(result)
        elif not isinstance(request.work, Step):
            request.answer.set_result(result)
        else:
            request.done.append(result)
            request.work = request.work.rest
            if request.work.actions:
                self._waiting.append(request)
                self._more.set()
            else:
                request.answer.set_result(request.done)
