"""Memory of a training step per device, with activations: which batch fits?

    python benchmarks/memory.py --size dit_s --size dit_xl --clips 4
    python benchmarks/memory.py --check         small sizes, against what this CPU takes

Counted, not measured: the network runs on tensors without memory, and whatever its backward pass
needs is added up, as a GPU keeps it in bfloat16 (attention keeps no scores). State is what
`acwm_core.training.layers.state_memory` counts for AdamW. The codec and what the allocator keeps
unused come on top.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn import functional
from training import peak_memory
from training_networks import PUBLISHED, SIZES, Ours, Size

import acwm_dit.blocks
from acwm_core.training.layers import recompute_activations, state_memory, trained_layers

WITHOUT_MEMORY = FakeTensorMode()
"""One for all networks, as they share cached tables."""


def attend_as_gpus_do(query: Tensor, key: Tensor, value: Tensor, **how: object) -> Tensor:
    """Attention by a kernel that keeps no scores."""
    return functional.scaled_dot_product_attention(
        query, key, value, attn_mask=how.get("mask"), is_causal=bool(how.get("causal"))
    )


def kept_bytes(run: Callable[[], Tensor], besides: set[int]) -> int:
    """Bytes of the tensors that `run` keeps for its backward pass, but those of these storages."""
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in besides:
            kept[storage._cdata] = storage.nbytes()
            held.append(tensor)
        return tensor

    held: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        made = run()
    assert made.requires_grad
    return sum(kept.values())


def kept_by(size: Size, precision: str, *, recomputed: bool) -> tuple[int, int]:
    """Bytes that a forward pass keeps for its backward pass, and the number of layers."""
    with WITHOUT_MEMORY, torch.autocast("cpu", torch.bfloat16, precision == "bfloat16"):
        network = Ours(size)
        layers = trained_layers(cast(Any, network))
        if recomputed:
            recompute_activations(layers)
        inputs = tuple(torch.empty_like(each) for each in size.inputs(torch.device("cpu")))
        weights = {each.untyped_storage()._cdata for each in network.parameters()}
        return kept_bytes(lambda: network(*inputs), weights), len(layers)


def activations(size: Size, precision: str, *, recomputed: bool) -> int:
    """The same, and with activation checkpointing what the layer needs that is computed again."""
    whole, layers = kept_by(size, precision, recomputed=False)
    if not recomputed:
        return whole
    kept, _ = kept_by(size, precision, recomputed=True)
    return kept + (whole - kept) // layers


def state(size: Size, devices: int) -> int:
    """Bytes of weights, gradients, moments and average."""
    with torch.device("meta"):
        return sum(state_memory(cast(Any, Ours(size)), devices).values())


def estimates(names: list[str], clips: list[int]) -> Table:
    """GB per device: state by number of devices, activations by clips per device."""
    table = Table("size", *(f"state / {n}" for n in (1, 8)), title="GB per device, bfloat16")
    for each in clips:
        table.add_column(f"{each} clips")
        table.add_column("recomputed")
    acwm_dit.blocks.attend = attend_as_gpus_do
    for name in names:
        cells = [f"{state(PUBLISHED[name], devices) / 1e9:.1f}" for devices in (1, 8)]
        for each in clips:
            size = replace(PUBLISHED[name], clips=each)
            for recomputed in (False, True):
                cells.append(f"{activations(size, 'bfloat16', recomputed=recomputed) / 1e9:.1f}")
        table.add_row(name, *cells)
    return table


def checks() -> Table:
    """MB of two steps of AdamW without an average: counted, and the peak of a process."""
    table = Table("size", "precision", "counted", "measured", title="MB on this CPU")
    for name, size in SIZES.items():
        for precision in ("float32", "bfloat16"):
            with torch.device("meta"):
                held = state_memory(cast(Any, Ours(size)))
            counted = sum(held.values()) - held["average"]
            counted += activations(size, precision, recomputed=False)
            measured = peak_memory("acwm", size, precision, torch.device("cpu"))
            table.add_row(name, precision, *(f"{n / 1e6:,.0f}" for n in (counted, measured)))
    return table


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--size", action="append", choices=PUBLISHED, help="all published sizes")
    parser.add_argument("--clips", type=int, action="append", help="per device; 1 and 4")
    parser.add_argument("--check", action="store_true", help="compare with what this CPU takes")
    arguments = parser.parse_args()
    names = arguments.size or [*PUBLISHED]
    table = checks() if arguments.check else estimates(names, arguments.clips or [1, 4])
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
