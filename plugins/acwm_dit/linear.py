"""Linear layers that use the fastest matrix products available on a CPU."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

SMALL = 2**21
"""Number of multiplications below which MKL is no slower: oneDNN takes longer to start."""


class Linear(nn.Linear):
    """`nn.Linear` that uses oneDNN where MKL, PyTorch's default for float32, is slow.

    On AMD processors MKL does not use AVX-512: measured on Zen 5, oneDNN multiplies 2.3 times as
    fast. Autocast to bfloat16 uses oneDNN anyway.
    """

    def forward(self, input: Tensor) -> Tensor:
        large = input.numel() * self.out_features >= SMALL
        if large and _suits_onednn(input) and self.weight.dtype == torch.float32:
            if not torch.is_grad_enabled():
                return _times_transposed(input, self.weight, self.bias)
            return cast(Tensor, _Product.apply(input, self.weight, self.bias))
        return super().forward(input)


def linear_gelu(layer: Linear, input: Tensor) -> Tensor:
    """Apply `layer`, then GELU in its tanh approximation.

    oneDNN computes the GELU of a product in a sixth of the time of PyTorch's kernel. It has no
    derivative of it, and a derivative needs the product itself, so training does not use it.
    """
    if torch.is_grad_enabled() or not (_suits_onednn(input) or _suits_bfloat16(input)):
        return functional.gelu(layer(input), approximate="tanh")
    dtype = torch.bfloat16 if _suits_bfloat16(input) else torch.float32
    weight, bias = layer.weight.to(dtype), layer.bias.to(dtype)
    return torch.ops.mkldnn._linear_pointwise(input.to(dtype), weight, bias, "gelu", [], "tanh")


def _suits_bfloat16(input: Tensor) -> bool:
    """Whether autocast to bfloat16 uses oneDNN's products, so that oneDNN can add the GELU too."""
    return (
        not torch.compiler.is_compiling()
        and input.device.type == "cpu"
        and torch.is_autocast_enabled("cpu")
        and torch.get_autocast_dtype("cpu") == torch.bfloat16
        and torch.backends.mkldnn.is_available()
        and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    )


def _suits_onednn(input: Tensor) -> bool:
    return (
        not torch.compiler.is_compiling()
        and input.device.type == "cpu"
        and input.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and mkl_is_slow()
    )


@functools.cache
def mkl_is_slow() -> bool:
    """Whether this is an AMD processor with AVX-512, and PyTorch has both MKL and oneDNN."""
    cpuinfo = Path("/proc/cpuinfo")
    return (
        torch.backends.mkl.is_available()
        and torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability() == "AVX512"
        and cpuinfo.exists()
        and "AuthenticAMD" in cpuinfo.read_text("utf-8")
    )


class _Product(torch.autograd.Function):
    """`input` `[…, K]` times the transposed `weight` `[N, K]`, plus a `bias` `[N]` if given."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(input, weight)
        return _times_transposed(input, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        input, weight = ctx.saved_tensors
        grad: Tensor = grads[0]
        rows, grad_rows = input.flatten(0, -2), grad.flatten(0, -2)
        wanted = ctx.needs_input_grad
        return (
            _times_transposed(grad, weight.t()) if wanted[0] else None,
            _weight_gradient(rows, grad_rows) if wanted[1] else None,
            grad_rows.sum(0) if wanted[2] else None,
        )


def _weight_gradient(rows: Tensor, grad_rows: Tensor) -> Tensor:
    """Gradient of the weight, `[N, K]`. oneDNN is faster with the narrower factor first."""
    if rows.shape[1] < grad_rows.shape[1]:
        return _times_transposed(rows.t(), grad_rows.t()).t()
    return _times_transposed(grad_rows.t(), rows.t())


def _times_transposed(left: Tensor, right: Tensor, bias: Tensor | None = None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(left, right, bias, "none", [], "")
