"""Latency and memory of `acwm serve` under load, beside a stream without a server.

    python benchmarks/serve.py push_cube --clients 64 --minutes 10

Every client asks for the next latent frame as soon as it has one. One in a hundred answers makes
its client vanish without a word, and another takes its place. Memory is that of the server's
process, read from /metrics. The clients run in this process and take some of the same cores.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass, field

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from websockets.asyncio.client import connect

from acwm_serve.engine import Engine, Step
from acwm_serve.messages import packed, unpacked

TOKEN = "a token of the benchmark"
VANISH = 0.01
"""Share of answers after which a client vanishes."""


@dataclass
class Load:
    """What clients have seen."""

    port: int
    latencies: list[float] = field(default_factory=list[float])
    memory: list[float] = field(default_factory=list[float])
    frames: int = 0
    vanished: int = 0
    batch: float = 0.0


def start_of(facts):
    """A start of noise, as the server's facts ask for one."""
    size = (*facts["frame_size"], 3)
    shape = size if facts["given"] == 1 else (facts["given"], *size)
    return {"frames": np.random.randint(0, 256, shape, np.uint8)}


def random_actions(facts):
    """Actions of a latent frame, uniform within the bounds."""
    shape = (facts["stride"], len(facts["low"]))
    return np.random.uniform(facts["low"], facts["high"], shape).astype(np.float32)


async def drive(load: Load, until: float) -> None:
    """One client after the other, until the time is over."""
    headers = {"Authorization": f"Bearer {TOKEN}"}
    while time.monotonic() < until:
        address = f"ws://127.0.0.1:{load.port}"
        async with connect(address, additional_headers=headers, max_size=None) as socket:
            facts = unpacked(await socket.recv())
            await socket.send(packed(start_of(facts)))
            await socket.recv()
            while time.monotonic() < until:
                began = time.monotonic()
                await socket.send(packed({"actions": random_actions(facts)}))
                answer = await socket.recv()
                if isinstance(answer, str):
                    raise SystemExit(answer)
                load.latencies.append(time.monotonic() - began)
                load.frames += len(unpacked(answer)["frames"])
                if random.random() < VANISH:
                    load.vanished += 1
                    socket.transport.abort()
                    break


async def watch(load: Load, until: float) -> None:
    """Read the server's memory until the time is over."""
    before = await asyncio.to_thread(metrics, load.port)
    while time.monotonic() < until:
        counts = await asyncio.to_thread(metrics, load.port)
        load.memory.append(counts["process_resident_memory_bytes"] / 2**20)
        asked, passes = (
            counts[f"acwm_batch_size_{name}"] - before[f"acwm_batch_size_{name}"]
            for name in ("sum", "count")
        )
        load.batch = asked / max(1, passes)
        await asyncio.sleep(min(5, max(0.1, until - time.monotonic())))


def metrics(port: int) -> dict[str, float]:
    """What `/metrics` reports, without histograms' buckets."""
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/metrics", headers={"Authorization": f"Bearer {TOKEN}"}
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        lines = answer.read().decode().splitlines()
    pairs = [line.split() for line in lines if not line.startswith("#") and "{" not in line]
    return {name: float(value) for name, value in pairs}


async def under_load(port: int, clients: int, seconds: float) -> Load:
    """Many clients for some seconds."""
    load, until = Load(port), time.monotonic() + seconds
    await asyncio.gather(watch(load, until), *(drive(load, until) for _ in range(clients)))
    return load


def without_server(run: str, seconds: float) -> Load:
    """One stream in this process."""
    engine, load = Engine(run), Load(0)
    facts = engine.facts()
    ((running, _),) = engine.start([engine.read_start(start_of(facts))])
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        began = time.monotonic()
        actions = engine.read_actions({"actions": random_actions(facts)})
        load.frames += len(engine.step([Step(running, actions)])[0]["frames"])
        load.latencies.append(time.monotonic() - began)
    return load


def row(name: str, load: Load, seconds: float) -> list[str]:
    """The cells of a load."""
    p50, p95 = np.percentile(load.latencies, [50, 95]) * 1000
    memory = [f"{load.memory[k]:.0f}" for k in (len(load.memory) // 4, -1)] if load.memory else []
    cells = [name, f"{p50:.0f}", f"{p95:.0f}", f"{load.frames / seconds:.1f}"]
    return [*cells, f"{load.batch:.1f}" if load.batch else "", " → ".join(memory)]


def main() -> None:
    """Measure without a server, with one client and with many, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", help="run folder, or the name of a trained model")
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--threads", type=int, help="of torch; its own number by default")
    parser.add_argument("--port", type=int, default=8429)
    asked = parser.parse_args()
    if asked.threads:
        torch.set_num_threads(asked.threads)
    seconds, short = asked.minutes * 60, max(5.0, asked.minutes * 3)
    alone = without_server(asked.run, short)
    words = ["serve", asked.run, "--port", str(asked.port), "--token", TOKEN]
    limits = ["--sessions", str(asked.clients + 8), "--queue", str(asked.clients + 8)]
    server = subprocess.Popen(
        [sys.executable, "-m", "acwm_core.cli", *words, *limits, "--timeout", "600"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout is not None
        while "serving at" not in (line := server.stdout.readline()):
            if not line:
                raise SystemExit("the server has not started")
        one = asyncio.run(under_load(asked.port, 1, short))
        many = asyncio.run(under_load(asked.port, asked.clients, seconds))
    finally:
        server.terminate()
        server.wait(60)
    table = Table("", "p50 ms", "p95 ms", "frames/s", "batch", "server MiB")
    table.add_row(*row("stream without a server", alone, short))
    table.add_row(*row("1 client", one, short))
    table.add_row(*row(f"{asked.clients} clients", many, seconds))
    Console(width=100).print(table)
    print(f"{many.vanished} clients vanished; memory after a quarter of the time and at its end")


if __name__ == "__main__":
    main()
