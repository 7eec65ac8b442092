"""Which precision is fast here: bfloat16 where the hardware multiplies it, float32 elsewhere."""

from __future__ import annotations

import functools
import os
import platform
import time
from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor, nn

ISA_LIMITS = ("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA")
"""Variables of the shell that keep oneDNN from instructions that the processor has."""

FASTER = 0.9
"""Share of the time of float32 that bfloat16 must take, where it is measured, to be worth it."""

CELLS, CHANNELS, REPETITIONS = 16, 64, 3
"""Size of the products that are timed, a few milliseconds each, and how often they are."""


@functools.cache
def bfloat16_is_fast() -> bool:
    """Whether this CPU computes faster in bfloat16 than in float32.

    It does where oneDNN uses AMX or AVX-512 BF16: the small DiT is 1.75 and 2.3 times as fast. It
    does not on x86-64 without these, as oneDNN then converts every value: on AVX2 a step of the
    demo's model took 7 times as long. Other processors, and shells that limit oneDNN's
    instructions, are judged by a few timed products.
    """
    if not onednn_multiplies_bfloat16():
        return False
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    is_limited = any(name in os.environ for name in ISA_LIMITS)
    if is_x86 and not cpu_has_bfloat16():
        return False
    if is_x86 and not is_limited:
        return True
    return bfloat16_slowdown(torch.device("cpu")) < FASTER


def onednn_multiplies_bfloat16() -> bool:
    """Whether PyTorch leaves products in bfloat16 to oneDNN; its own are many times slower."""
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def cpu_has_bfloat16() -> bool:
    """Whether this x86-64 processor has instructions for products: AMX tiles or AVX-512 BF16."""
    amx = torch.cpu._is_amx_tile_supported()  # pyright: ignore[reportPrivateUsage]
    avx = torch.cpu._is_avx512_bf16_supported()  # pyright: ignore[reportPrivateUsage]
    return amx or avx


def gpu_has_bfloat16() -> bool:
    """Whether the GPU multiplies bfloat16 in hardware; older ones emulate it."""
    return torch.cuda.is_bf16_supported(including_emulation=False)


def bfloat16_slowdown(device: torch.device) -> float:
    """Time of a convolution and a matrix product with their gradients, relative to float32."""
    side, width = CELLS, CHANNELS * 4
    with cast(Any, torch.random).fork_rng():  # the caller's random numbers stay what they were
        image = torch.randn(side, CHANNELS, side, side, device=device)
        image = image.contiguous(memory_format=torch.channels_last)
        convolution = nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1, device=device)
        rows = torch.randn(side**2, width, device=device)
        product = nn.Linear(width, width, device=device)
    layers = ((convolution, image), (product, rows))
    reduced, full = (
        sum(_fastest(functools.partial(_step, *layer, on)) for layer in layers)
        for on in (True, False)
    )
    return reduced / full


def _step(layer: nn.Module, values: Tensor, reduced: bool) -> None:
    with torch.autocast(values.device.type, torch.bfloat16, enabled=reduced):
        result: Tensor = layer(values)
    cast(Any, result.float().square().mean()).backward()
    if values.device.type == "cuda":
        torch.cuda.synchronize(values.device)


def _fastest(work: Callable[[], Any]) -> float:
    """The shortest of several times in seconds, after one that does not count."""
    work()
    times = list[float]()
    for _ in range(REPETITIONS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)
