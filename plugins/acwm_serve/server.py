"""The server: a websocket for sessions, ``/health``, and ``/metrics`` for Prometheus."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import click
import numpy as np
from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from acwm_core.errors import AcwmError, DataError, RecipeError, sentence
from acwm_serve.batcher import Batcher
from acwm_serve.engine import CHUNK, Answer, Engine, Running, Step
from acwm_serve.messages import packed, unpacked
from acwm_serve.metrics import Metrics
from acwm_serve.plans import GoalPlanner

HEARTBEAT = 20.0
"""Seconds after which the server notices that a client is gone."""

SLACK = 1 << 16
"""Bytes of a message besides its arrays."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True)
class Limits:
    """What a server puts up with.

    Attributes:
        sessions: most clients at once.
        queue: most requests that wait.
        batch: most requests in one forward pass.
        timeout: seconds that a request may wait.
        idle: seconds without a message after which a session ends.
    """

    sessions: int = 64
    queue: int = 64
    batch: int = 64
    timeout: float = 30.0
    idle: float = 300.0


@dataclass
class Session:
    """What one client has begun."""

    running: Running | None = None
    planner: GoalPlanner | None = None


class Server:
    """The routes of one server.

    Args:
        engine: the model.
        secret: the token that clients send.
        limits: see `Limits`.
    """

    def __init__(self, engine: Engine, secret: str, limits: Limits) -> None:
        self._engine, self._secret, self._limits = engine, secret, limits
        self._metrics = Metrics()
        self._sockets: set[web.WebSocketResponse] = set()
        size, actions = engine.card.frame_size, engine.card.action.size
        frames = max(engine.given, CHUNK * engine.stride if engine.plans else 0) + 1
        pixels = frames * size[0] * size[1] * 3
        self._most = pixels + 8 * CHUNK * engine.stride * actions + SLACK

    def application(self) -> web.Application:
        """The application for aiohttp."""
        application = web.Application(middlewares=[self._guard])
        application.router.add_get("/", self._socket)
        application.router.add_get("/health", self._health)
        application.router.add_get("/metrics", self._show_metrics)
        application.on_startup.append(self._begin)
        application.on_shutdown.append(self._say_goodbye)
        application.on_cleanup.append(self._end)
        return application

    async def _begin(self, _: web.Application) -> None:
        limits = self._limits
        self._batcher = Batcher(
            self._engine,
            self._metrics,
            queue=limits.queue,
            batch=limits.batch,
            timeout=limits.timeout,
        )
        self._batcher.begin()

    async def _say_goodbye(self, _: web.Application) -> None:
        for socket in [*self._sockets]:
            await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the server ends")

    async def _end(self, _: web.Application) -> None:
        await self._batcher.close()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests without the token, but those for the health."""
        given = request.headers.get("Authorization", "").partition(" ")[2]
        right = hmac.compare_digest(given.encode(), self._secret.encode())
        if not right and request.path != "/health":
            text = "send the token that `acwm serve` printed: `Authorization: Bearer TOKEN`\n"
            raise web.HTTPUnauthorized(text=text)
        return await handler(request)

    async def _health(self, _: web.Request) -> web.StreamResponse:
        alive = self._batcher.alive
        facts = {"status": "ok" if alive else "failed", "environment": self._engine.card.name}
        return web.json_response(facts, status=200 if alive else 503)

    async def _show_metrics(self, _: web.Request) -> web.StreamResponse:
        return web.Response(body=self._metrics.text(), content_type="text/plain", charset="utf-8")

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._sockets) >= self._limits.sessions:
            most = f"{self._limits.sessions} sessions are open already: come back later\n"
            raise web.HTTPServiceUnavailable(text=most)
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT, max_msg_size=self._most)
        if not socket.can_prepare(request).ok:
            raise web.HTTPUpgradeRequired(text="this address speaks websocket only\n")
        self._sockets.add(socket)
        self._metrics.sessions.set(len(self._sockets))
        try:
            await socket.prepare(request)
            await self._serve(socket)
        except ConnectionError:  # the client is gone
            pass
        finally:
            self._sockets.discard(socket)
            self._metrics.sessions.set(len(self._sockets))
            await socket.close()
        return socket

    async def _serve(self, socket: web.WebSocketResponse) -> None:
        """Answer one client until it leaves."""
        await socket.send_bytes(packed(self._engine.facts()))
        session = Session()
        async for message in self._messages(socket):
            began = time.monotonic()
            try:
                answer = await self._answer(message.data, session)
            except AcwmError as error:
                self._metrics.refused.inc()
                await socket.send_str(sentence(error))
                continue
            self._metrics.frames.inc(len(answer.get("frames", ())))
            self._metrics.latency.observe(time.monotonic() - began)
            await socket.send_bytes(packed(answer))

    async def _messages(self, socket: web.WebSocketResponse) -> AsyncIterator[WSMessage]:
        """A client's messages until it leaves or is idle.

        The next one is waited for while one is answered: aiohttp answers pings only then.
        """
        receiving = asyncio.ensure_future(socket.receive())
        try:
            while True:
                await asyncio.wait({receiving}, timeout=self._limits.idle)
                if not receiving.done():
                    reason = f"no message for {self._limits.idle:g} s".encode()
                    receiving.cancel()
                    await asyncio.gather(receiving, return_exceptions=True)
                    await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=reason)
                    return
                message = receiving.result()
                if message.type not in (WSMsgType.BINARY, WSMsgType.TEXT):
                    return
                receiving = asyncio.ensure_future(socket.receive())
                yield message
        finally:
            receiving.cancel()

    async def _answer(self, data: Any, session: Session) -> Answer:
        """What to send after a message."""
        if not isinstance(data, bytes):
            raise DataError("a message is a map in msgpack, not text")
        message = unpacked(data)
        if "observed" in message:
            session.planner = session.planner or self._engine.planner()
            return await self._batcher.plan(self._engine.read_plan(message, session.planner))
        if "frames" in message:
            session.running, answer = await self._batcher.start(self._engine.read_start(message))
            return answer
        if session.running is None:
            raise RecipeError("send `frames` to start, and then `actions`")
        step = Step(session.running, self._engine.read_actions(message))
        return _chained(await self._batcher.step(step))


def _chained(answers: list[Answer]) -> Answer:
    """The answers to successive latent frames as one."""
    if len(answers) == 1:
        return answers[0]
    whole: Answer = {}
    for name, first in answers[0].items():
        values = [answer[name] for answer in answers]
        if name == "keypoints":
            whole[name] = values[-1]
        elif isinstance(first, dict):
            whole[name] = {n: np.concatenate([value[n] for value in values]) for n in first}
        else:
            whole[name] = np.concatenate(values)
    return whole


def serve(engine: Engine, secret: str, limits: Limits, *, host: str, port: int) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Raises:
        RecipeError: the address cannot be used.
    """
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(Server(engine, secret, limits), secret, host, port))


async def _serve(server: Server, secret: str, host: str, port: int) -> None:
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=5)
    ended = asyncio.Event()
    with contextlib.suppress(NotImplementedError):
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except OSError as error:
            raise RecipeError(
                f"{host}:{port} cannot be used ({error.strerror}): give another --host or --port"
            ) from error
        click.echo(f"serving at ws://{host}:{runner.addresses[0][1]} (Ctrl-C to stop)")
        click.echo(f"token: {secret}")
        if not _is_local(host):
            click.echo("others on the network can read what is sent: put TLS before the server")
        await ended.wait()
    finally:
        await runner.cleanup()


def _is_local(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"
