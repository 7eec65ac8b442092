"""``acwm`` in milliseconds: a server that has imported everything forks a process per command.

`python forking.py serve SOCKET` is the server; it ends when its standard input does. What
`command(SOCKET)` gives is put before the words of a command and behaves as the command itself: it
has its output and exit code, passes signals on, and takes it along when it is killed.
"""

import array
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)


def command(path):
    """The client, with as little of Python as can be."""
    return (sys.executable, "-I", "-S", __file__, "run", str(path))


def run(path, *words):
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(path)
    order = json.dumps([words, str(Path.cwd()), dict(os.environ)]).encode()
    streams = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))
    connection.sendmsg([len(order).to_bytes(4, "big")], [streams])
    connection.sendall(order)
    for number in SIGNALS:
        signal.signal(number, lambda number, frame: connection.sendall(bytes([number])))
    ended = connection.recv(2) or bytes([signal.SIGKILL, 0])
    if ended[0]:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), ended[0])
    sys.exit(ended[1])


def serve(path):
    """Fork for every connection; single-threaded, as forks of threads would be unsafe."""
    import acwm_core.evaluation.evaluate
    import acwm_core.training.fit  # noqa: F401
    from acwm_core.plugins import catalog
    from acwm_experiment import commands
    from tests.experiment.parts import Plugin

    catalog().add_plugin(Plugin, "tiny_experiment_parts")
    commands.COMMAND = command(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(path)
    listener.listen(16)
    print("ready", flush=True)
    children = {}
    while True:
        readable, _, _ = select.select([0, listener, *children.values()], [], [], 0.01)
        if 0 in readable:
            os._exit(0)
        if listener in readable:
            accept(listener, children)
        for pid, connection in list(children.items()):
            if connection in readable:
                number = connection.recv(1)
                os.kill(pid, number[0] if number else signal.SIGKILL)
                if not number:
                    os.waitpid(pid, 0)
                    children.pop(pid).close()
                    continue
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                code = os.waitstatus_to_exitcode(status)
                connection.sendall(bytes([max(-code, 0), max(code, 0)]))
                children.pop(pid).close()


def accept(listener, children):
    connection, _ = listener.accept()
    size, rights, _, _ = connection.recvmsg(4, socket.CMSG_SPACE(12))
    streams = array.array("i", rights[0][2])
    order = b""
    while len(order) < int.from_bytes(size, "big"):
        order += connection.recv(65536)
    pid = os.fork()
    if not pid:
        for place, stream in enumerate(streams):
            os.dup2(stream, place)
        listener.close()
        for other in (connection, *children.values()):
            other.close()
        become(*json.loads(order))
    for stream in streams:
        os.close(stream)
    children[pid] = connection


def become(words, folder, environment):
    """Be the command."""
    from acwm_core.cli import main
    from acwm_core.cli.__main__ import ENDS_WITH_INPUT, end_with_input

    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if ENDS_WITH_INPUT in environment:
        threading.Thread(target=end_with_input, daemon=True).start()
    try:
        main(list(words))
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 70
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


class Server:
    """Starts the server, and knows how to ask it."""

    def __init__(self, folder):
        self.path = str(folder / "socket")
        root = Path(__file__).parents[2]
        paths = f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, __file__, "serve", self.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )
        assert self.process.stdout.readline() == b"ready\n"

    def start(self, *words, cwd, **environment):
        """The command as a running process, with its output in pipes."""
        return subprocess.Popen(
            [*command(self.path), *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
            env={**os.environ, **environment},
        )

    def __call__(self, *words, cwd, **environment):
        """The exit code, output and errors of a command."""
        process = self.start(*words, cwd=cwd, **environment)
        out, err = process.communicate(timeout=600)
        return process.returncode, out, err

    def close(self):
        self.process.communicate(timeout=600)


if __name__ == "__main__":
    {"serve": serve, "run": run}[sys.argv[1]](*sys.argv[2:])
