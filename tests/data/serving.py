"""A real HTTP server of a folder that counts requests and misbehaves as it is told."""

import contextlib
import threading
from collections import Counter
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class Server(ThreadingHTTPServer):
    """Serves a folder on a free port of this machine.

    Attributes:
        asked: how often each path was asked for.
        faults: per path a list of what to do wrong, the next one first: an error code,
            ``"cut"``, ``"flip"`` (another last byte), ``"slow"`` or ``"stalls"`` (half of it).
        ending: whether nobody needs the rest of what stalls.
    """

    daemon_threads = True

    def __init__(self, folder):
        super().__init__(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.asked, self.faults, self.ending = Counter(), {}, threading.Event()
        self.url = f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, request, client_address):
        """Clients that are killed leave in the middle."""


class Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_GET(self):
        self.server.asked[self.path] += 1
        faults = self.server.faults.get(self.path)
        fault = faults.pop(0) if faults else None
        if isinstance(fault, int):
            self.send_error(fault)
        elif fault is None:
            super().do_GET()
        else:
            self._send(fault)

    def _send(self, fault):
        data = Path(self.translate_path(self.path)).read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if fault == "cut":
            self.wfile.write(data[: len(data) // 2])
        elif fault == "flip":
            self.wfile.write(data[:-1] + bytes([data[-1] ^ 1]))
        else:
            self.wfile.write(data[: len(data) // 2])
            self.wfile.flush()
            self.server.ending.wait(1 if fault == "slow" else None)
            self.wfile.write(data[len(data) // 2 :])


@contextlib.contextmanager
def served(folder):
    """A running server of `folder`."""
    server = Server(folder)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        server.ending.set()
        server.shutdown()
        thread.join()
        server.server_close()
