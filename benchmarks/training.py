"""Time and memory of a training step, compared with the published network and diffusers' Latte.

    python benchmarks/training.py                     # every size that the device can train
    python benchmarks/training.py --size small --quick

Networks of equal width, depth and tokens (`training_networks.py`) take turns in one process, one
repetition at a time, in float32 and in bfloat16 (autocast, as in training). What counts is the
ratio "× acwm": their time relative to ours. A step is forward, backward and AdamW. "GFLOP/s" is the
rate of counted operations (matrix products and attention) in a step, and "share" compares it with
one large matrix product, measured in between. Memory is the peak of two steps in a separate
process, minus what it held before the network was built: resident memory on a CPU, allocated
memory on a GPU.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from rich.table import Table
from torch import nn
from torch._inductor.exc import InductorError
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from training_networks import NETWORKS, PUBLISHED, SIZES, Inputs, Size, build

from acwm_dit.linear import Linear

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
ALL_SIZES = {**SIZES, **PUBLISHED}
OURS = "acwm"


@dataclass
class Way:
    """One network in one precision, with its seconds per repetition."""

    name: str
    precision: str
    compiled: bool
    network: nn.Module
    optimizer: torch.optim.Optimizer
    forwards: list[float]
    steps: list[float]

    @classmethod
    def of(cls, name: str, size: Size, precision: str, device: torch.device, compiled: bool) -> Way:
        """Build the network and its optimiser."""
        network = build(name, size, device)
        optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, fused=True)
        if compiled:
            cast(
                Any, network
            ).model.compile()  # as in training, which does not compile conditioners
        return cls(name, precision, compiled, network, optimizer, [], [])

    @property
    def label(self) -> str:
        """Its name in the table."""
        return f"{self.name}, compiled" if self.compiled else self.name

    def forward(self, inputs: Inputs) -> None:
        """Make a prediction, as in sampling."""
        with torch.no_grad(), self._autocast(inputs):
            self.network(*inputs)

    def step(self, inputs: Inputs) -> None:
        """Do a training step."""
        self.backward(inputs)
        self.optimizer.step()
        self.optimizer.zero_grad()

    def backward(self, inputs: Inputs) -> None:
        """Do a forward and a backward pass."""
        with self._autocast(inputs):
            out = self.network(*inputs)
        (out.float() - inputs[0]).square().mean().backward()

    def _autocast(self, inputs: Inputs) -> torch.autocast:
        wanted = self.precision == "bfloat16"
        device = inputs[0].device.type
        return torch.autocast(device, torch.bfloat16, enabled=wanted, cache_enabled=False)

    def run_once(self, inputs: Inputs) -> None:
        """Measure one repetition of each kind."""
        device = inputs[0].device
        self.forwards.append(seconds(lambda: self.forward(inputs), device))
        self.steps.append(seconds(lambda: self.step(inputs), device))

    def forget(self) -> None:
        """Drop the measurements of the warm-up."""
        self.forwards.clear()
        self.steps.clear()


def warmed_up(way: Way, inputs: Inputs) -> bool:
    """Run twice to warm up; returns whether it works, as PyTorch cannot compile every network."""
    try:
        for _ in range(2):
            way.run_once(inputs)
    except InductorError as error:
        print(f"{way.precision}, {way.label}: {str(error).splitlines()[0]}", file=sys.stderr)
        return False
    way.forget()
    return True


class Products:
    """A large matrix product: its rate is the limit for networks of matrix products."""

    def __init__(self, precision: str, device: torch.device) -> None:
        side = 8192 if device.type == "cuda" else 2048
        dtype = PRECISIONS[precision]
        self._factor = torch.randn(side, side, device=device, dtype=dtype)
        self._times = Linear(side, side, bias=False, device=device, dtype=dtype)
        self._rates: list[float] = []

    def run_once(self) -> None:
        """Measure one product."""
        with torch.no_grad():
            taken = seconds(lambda: self._times(self._factor), self._factor.device)
        self._rates.append(2 * len(self._factor) ** 3 / taken)

    @property
    def rate(self) -> float:
        """Operations per second."""
        return statistics.median(self._rates)


def seconds(run: Callable[[], Any], device: torch.device) -> float:
    """Seconds of a call, including everything that it starts on the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    started = time.perf_counter()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started


def operations(name: str, size: Size) -> int:
    """Operations of a forward and a backward pass; a multiply-add counts as two."""
    one, device = replace(size, clips=1), torch.device("cpu")
    # In bfloat16 and with explicit attention, every product is of a kind that is counted.
    way = Way.of(name, one, "bfloat16", device, compiled=False)
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        way.backward(one.inputs(device))
    return counter.get_total_flops() * size.clips


def measure(
    size: Size, precision: str, device: torch.device, repetitions: int, *, compiled: bool
) -> tuple[list[Way], Products]:
    """Measure all networks in turns."""
    inputs, products = size.inputs(device), Products(precision, device)
    kinds = (False, True) if compiled else (False,)
    ways = [Way.of(name, size, precision, device, kind) for kind in kinds for name in NETWORKS]
    ways = [way for way in ways if warmed_up(way, inputs)]
    for _ in range(repetitions):
        products.run_once()
        for way in ways:
            way.run_once(inputs)
    return ways, products


def peak_memory(name: str, size: Size, precision: str, device: torch.device) -> int:
    """Bytes that two steps take in a separate process, including network and optimiser."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as alone:
        threads = torch.get_num_threads()
        measured = alone.submit(_peak_memory_here, name, size, precision, str(device), threads)
        return measured.result()


def _peak_memory_here(name: str, size: Size, precision: str, device: str, threads: int) -> int:
    torch.set_num_threads(threads)
    place = torch.device(device)
    inputs, before = size.inputs(place), _resident("VmRSS")
    way = Way.of(name, size, precision, place, compiled=False)
    for _ in range(2):
        way.step(inputs)
    if place.type == "cuda":
        return torch.cuda.max_memory_allocated(place)
    return _resident("VmHWM") - before


def _resident(kind: str) -> int:
    """Resident memory of this process in bytes: current (`VmRSS`) or peak (`VmHWM`)."""
    # `resource` is not used, as its peak includes the parent's memory when this process started.
    (line,) = re.findall(rf"{kind}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(line) * 1024


def rows(
    name: str,
    precision: str,
    device: torch.device,
    repetitions: int,
    *,
    compiled: bool,
    quick: bool,
) -> list[list[str]]:
    """The table lines for a size in one precision."""
    size = ALL_SIZES[name]
    ways, products = measure(size, precision, device, repetitions, compiled=compiled)
    ours = next(way for way in ways if way.name == OURS and way.compiled == compiled)
    lines: list[list[str]] = []
    for way in ways:
        forward, step = statistics.median(way.forwards), statistics.median(way.steps)
        forward_ratio = forward / statistics.median(ours.forwards)
        step_ratio = step / statistics.median(ours.steps)
        rate = operations(way.name, size) / step
        line = [f"{precision}, {way.label}", f"{1e3 * forward:.1f}", f"{forward_ratio:.2f}"]
        line += [f"{1e3 * step:.1f}", f"{step_ratio:.2f}"]
        line += [f"{rate / 1e9:,.0f}", f"{rate / products.rate:.0%}"]
        if not quick and not way.compiled:
            line.append(f"{peak_memory(way.name, size, precision, device) / 1e6:,.0f}")
        lines.append(line)
    empty = [""] * 4
    return [*lines, [f"{precision}, one product", *empty, f"{products.rate / 1e9:,.0f}"]]


def table_of(name: str, device: torch.device, threads: int) -> Table:
    """An empty table whose title says what was computed and where."""
    size = ALL_SIZES[name]
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{threads} threads"
    title = (
        f"{name}: width {size.width}, {size.layers} layers, {size.clips} × {size.frames} × "
        f"{size.side}² = {size.tokens:,} tokens, {where}"
    )
    table = Table("network", title=title)
    heads = ("forward ms", "× acwm", "step ms", "× acwm", "GFLOP/s", "share", "MB")
    for head in heads:
        table.add_column(head, justify="right")
    return table


def main() -> None:
    """Measure and print a table per size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--size", action="append", choices=ALL_SIZES, help="all that fit the device"
    )
    parser.add_argument("--precision", action="append", choices=PRECISIONS, help="both")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repetitions", type=int, default=12)
    parser.add_argument("--threads", type=int, help="for a CPU; PyTorch's choice")
    parser.add_argument("--quick", action="store_true", help="two repetitions, no memory")
    parser.add_argument(
        "--compile",
        action=argparse.BooleanOptionalAction,
        help="also compiled by torch.compile; ratios are then to ours compiled; on a GPU, yes",
    )
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    on_gpu = device.type == "cuda"
    compiled = on_gpu if arguments.compile is None else arguments.compile
    options = {"compiled": compiled, "quick": arguments.quick}
    repetitions = 2 if arguments.quick else arguments.repetitions
    for name in arguments.size or (ALL_SIZES if on_gpu else SIZES):
        table = table_of(name, device, torch.get_num_threads())
        for precision in arguments.precision or PRECISIONS:
            for row in rows(name, precision, device, repetitions, **options):
                table.add_row(*row)
            table.add_section()
        Console(width=110).print(table)


if __name__ == "__main__":
    main()
