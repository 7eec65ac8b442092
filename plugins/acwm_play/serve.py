"""The server of the page. It serves this machine only, and requires the token."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import signal
import webbrowser
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import click
from aiohttp import WSCloseCode, WSMsgType, web

from acwm_core.errors import DataError
from acwm_play.address import HOST, open_socket, token
from acwm_play.messages import MAX_MESSAGE, parse
from acwm_play.pool import WorldPool
from acwm_play.session import Session
from acwm_play.worlds import World

PAGE = Path(__file__).with_name("page")

FILES = {
    "": "text/html",
    "goal.js": "text/javascript",
    "play.js": "text/javascript",
    "play.css": "text/css",
}
"""Files that are served besides the socket: content type by name."""

MAX_SESSIONS = 4
"""Most tabs at the same time; each has its own simulation and prediction."""

HEARTBEAT = 20.0
"""Seconds after which the server notices that a page is gone."""

SAVING = 60.0
"""Seconds that the server waits at its end for recordings to be saved."""

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


THROUGH_SSH = (
    "this page answers on localhost only, not behind a proxy; to open it on another machine, run "
    "`ssh -L PORT:localhost:PORT THIS_MACHINE` there, with the port that `acwm play` printed, and "
    "open the address that it printed\n"
)


class Server:
    """The routes of one server.

    Args:
        pool: shared by all sessions.
        out: folder for recordings.
        secret: the token; the first part of every path.
    """

    def __init__(self, pool: WorldPool, out: Path, secret: str) -> None:
        self._pool, self._out, self.secret = pool, out, secret
        self._sockets: dict[web.WebSocketResponse, asyncio.Task[None]] = {}

    def application(self) -> web.Application:
        """The application for aiohttp."""
        application = web.Application(middlewares=[self._guard])
        application.router.add_get("/{token}/socket", self._socket)
        application.router.add_get("/{token}/{file:[a-z.]*}", self._file)
        application.on_shutdown.append(self._close_pages)
        return application

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse wrong tokens, and wrong host names (which prevents DNS rebinding)."""
        host = request.host.rpartition(":")[0] or request.host
        given = request.match_info.get("token", "")
        if host not in (HOST, "localhost"):
            raise web.HTTPForbidden(text=THROUGH_SSH)
        if not hmac.compare_digest(given.encode(), self.secret.encode()):
            raise web.HTTPForbidden(text="open the address that `acwm play` printed\n")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(
                {
                    "Content-Security-Policy": POLICY.format(host=request.host),
                    "Cache-Control": "no-store",
                    "Referrer-Policy": "no-referrer",
                    "X-Content-Type-Options": "nosniff",
                    "Cross-Origin-Resource-Policy": "same-origin",
                    "Cross-Origin-Opener-Policy": "same-origin",
                }
            )
        return response

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["file"]
        if name not in FILES:
            raise web.HTTPNotFound
        text = (PAGE / (name or "index.html")).read_text(encoding="utf-8")
        return web.Response(text=text, content_type=FILES[name])

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        """Run a session. Only our own page may connect: browsers send the origin of the page."""
        if request.headers.get("Origin") != f"http://{request.host}":
            raise web.HTTPForbidden(text="requests from other pages are refused\n")
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT, max_msg_size=MAX_MESSAGE)
        await socket.prepare(request)
        if len(self._sockets) >= MAX_SESSIONS:
            reason = f"{MAX_SESSIONS} pages are already open".encode()
            await socket.close(code=WSCloseCode.TRY_AGAIN_LATER, message=reason)
            return socket
        playing = self._sockets[socket] = asyncio.ensure_future(self._play(socket))
        try:
            await asyncio.shield(playing)
        finally:
            playing.add_done_callback(lambda _: self._sockets.pop(socket))
        return socket

    async def _play(self, socket: web.WebSocketResponse) -> None:
        """Play until the page leaves, sends an invalid message, or something fails."""
        more = asyncio.Event()
        session = Session(self._pool, self._out, more)
        parts = [_receive(socket, session), _send(socket, session, more), session.run()]
        tasks = [asyncio.ensure_future(part) for part in parts]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except DataError as error:
            await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode()[:120])
        except ConnectionError:  # the page is gone
            pass
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await socket.close()

    async def _close_pages(self, _: web.Application) -> None:
        """Tell all pages that the server ends, and wait until their recordings are saved."""
        playing = dict(self._sockets)
        for socket in playing:
            await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the server ends")
        if playing:
            await asyncio.wait(playing.values(), timeout=SAVING)


async def _receive(socket: web.WebSocketResponse, session: Session) -> None:
    """Pass the page's messages to the session until the page leaves."""
    async for message in socket:
        if message.type is WSMsgType.TEXT:
            session.receive(parse(message.data))


async def _send(socket: web.WebSocketResponse, session: Session, more: asyncio.Event) -> None:
    """Send waiting messages. With a slow page this waits, and the outbox drops old frames."""
    while True:
        message = session.outbox.take()
        if message is None:
            more.clear()
            await more.wait()
        elif isinstance(message, str):
            await socket.send_str(message)
        else:
            await socket.send_bytes(message)


def serve(
    worlds: Sequence[World],
    *,
    out: Path,
    steps: int | None = None,
    port: int | None = None,
    browser: bool = True,
) -> None:
    """Serve the page until Ctrl-C."""
    pool = WorldPool(worlds, steps)
    server = Server(pool, out, token())
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(pool, server, port, browser))


async def _serve(pool: WorldPool, server: Server, port: int | None, browser: bool) -> None:
    socket = open_socket(port)
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=5)
    ended = asyncio.Event()
    with contextlib.suppress(NotImplementedError):
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    try:
        await pool.warm_up()
        await runner.setup()
        await web.SockSite(runner, socket).start()
        address = f"http://{HOST}:{socket.getsockname()[1]}/{server.secret}/"
        click.echo(f"playing at {address} (Ctrl-C to stop)")
        if browser:
            asyncio.get_running_loop().run_in_executor(None, webbrowser.open, address)
        await ended.wait()
    finally:
        await runner.cleanup()
        await pool.close()
        socket.close()
