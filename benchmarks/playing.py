"""Frames per second of `acwm play`: what a page gets of the simulator and the model together.

    python benchmarks/playing.py [MODEL…] [--seconds 20]

Starts the server for each model, by default those that ship, and listens as a page does while the
behaviour policy acts and figures are read. Worlds show ten frames per second in real time. Frames
come by the latent frame, so a steady picture has pauses of 100 ms times the codec's stride.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import aiohttp
import numpy as np
from rich.console import Console
from rich.table import Table

from acwm_core.plugins import catalog

WARM_UP = 5.0
"""Seconds that are not measured."""


async def listen(url: str, seconds: float) -> list[tuple[float, dict[str, Any]]]:
    """When the frames of an episode of the behaviour policy arrived, and their headers."""
    found: list[tuple[float, dict[str, Any]]] = []
    origin = re.sub(r"(http://[^/]+).*", r"\1", url)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url.rstrip('/')}/socket", origin=origin, max_msg_size=0) as socket,
    ):
        for wish in ({"type": "open", "index": 0}, {"type": "drive", "by": "policy"}):
            await socket.send_str(json.dumps(wish))
        started = time.monotonic()
        async for message in socket:
            now = time.monotonic() - started
            if message.type is aiohttp.WSMsgType.BINARY:
                (length,) = struct.unpack_from("<I", message.data)
                found.append((now, json.loads(message.data[4 : 4 + length])))
            if now > WARM_UP + seconds:
                break
    return [each for each in found if each[0] > WARM_UP]


def played(model: str, seconds: float) -> list[tuple[float, dict[str, Any]]]:
    """Listen to a server of its own."""
    code = "from acwm_core.cli import main; main()"
    command = [sys.executable, "-P", "-c", code, "play", model, "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as server:
        assert server.stdout is not None
        try:
            for line in server.stdout:
                if address := re.search(r"http://\S+", line.decode()):
                    return asyncio.run(listen(address[0], seconds))
        finally:
            server.terminate()
    raise SystemExit(f"acwm play {model} did not start")


def row(model: str, heard: Sequence[tuple[float, dict[str, Any]]]) -> tuple[str, ...]:
    """Frames per second, pauses between messages, and frames that were never sent."""
    times = np.array([moment for moment, _ in heard])
    frames = sum(head["n"] for _, head in heard[1:])
    pauses = 1000 * np.diff(times)
    rate = f"{frames / (times[-1] - times[0]):.1f}"
    lost = str(heard[-1][1]["dropped"])
    return model, rate, f"{np.median(pauses):.0f} ms", f"{pauses.max():.0f} ms", lost


def main() -> None:
    """Measure each model in turn."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    shipped = [each.name for each in catalog().registry("trained_model") if each.name != "hf"]
    parser.add_argument("models", nargs="*", default=shipped)
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    table = Table("model", "frames/s", "median pause", "longest pause", "messages lost")
    for model in asked.models:
        table.add_row(*row(model, played(model, asked.seconds)))
    Console().print(table)


if __name__ == "__main__":
    main()
