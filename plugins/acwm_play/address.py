"""The address of the page: a port, and a token that other programs and pages cannot guess.

The token is stored in a file that only its user can read, so that an open page finds the server
again after a restart.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import socket

from acwm_core.errors import RecipeError
from acwm_core.files import cache_folder

HOST = "127.0.0.1"

PORT = 8426
"""The default port, used if it is free."""


def token() -> str:
    """The user's token, created on first use; a new one each time if no file can be written."""
    path = cache_folder() / "play-token"
    with contextlib.suppress(OSError, UnicodeDecodeError):
        status = path.lstat()
        private = not status.st_mode & 0o077 and status.st_uid == os.getuid()
        stored = path.read_text(encoding="ascii") if private and path.is_file() else ""
        if re.fullmatch(r"[\w-]{40,80}", stored):
            return stored
    fresh = secrets.token_urlsafe(32)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(fresh)
    return fresh


def open_socket(port: int | None) -> socket.socket:
    """Open a local socket on `port` (0 for any free port); by default `PORT`, else a free port.

    Raises:
        RecipeError: the port is taken.
    """
    for candidate in [PORT, 0] if port is None else [port]:
        server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((HOST, candidate))
        except OSError:
            server.close()
        else:
            return server
    raise RecipeError(f"port {port} is taken: choose another --port, or omit it")
