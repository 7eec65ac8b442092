"""Converts published ACWM-DiT weights to ours."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from acwm_core.errors import DataError
from acwm_dit.actions import ConvolutionalActions
from acwm_dit.adaln import AdaLN
from acwm_dit.cross_attention import CrossAttention
from acwm_dit.dit import DiT


@dataclass(frozen=True)
class _Source:
    """The source of one of our tensors: its published name, its shape, and how to convert it."""

    name: str
    shape: tuple[int, ...]
    change: Callable[[Tensor], Tensor]


def convert(
    published: Mapping[str, Tensor], model: DiT, conditioner: AdaLN | CrossAttention
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Convert published weights to state dicts for `model` and `conditioner`.

    The published network differs in three ways. It keeps the conditioner's layers inside the
    model's layers. It makes patches with a convolution. And it rotates pairs of neighbouring
    channels of a head, where ours rotates channels half a head apart; so the rows of the query and
    key projections are reordered.

    Args:
        published: tensors by published name, such as ``blocks.0.s_block.attn.qkv_proj.weight``.
        model: the model to convert for, on any device (even meta); gives sizes and heads.
        conditioner: the conditioner, with ``embedding="convolutional"``.

    Returns:
        The state dicts for `model.load_state_dict` and `conditioner.load_state_dict`.

    Raises:
        DataError: a tensor is missing, unexpected, or has the wrong shape; names the tensor.
    """
    if not isinstance(conditioner.embedder, ConvolutionalActions):
        raise DataError(
            "published weights embed actions with convolutions; give the conditioner "
            "embedding=convolutional"
        )
    sources = _sources(model), _sources(conditioner)
    _check(published, [source for part in sources for source in part.values()])
    converted = tuple(
        {name: source.change(published[source.name]) for name, source in part.items()}
        for part in sources
    )
    return converted[0], converted[1]


def published_shapes(model: DiT, conditioner: AdaLN | CrossAttention) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published tensors that `convert` takes for these modules."""
    sources = [*_sources(model).values(), *_sources(conditioner).values()]
    return {source.name: source.shape for source in sources}


def _check(published: Mapping[str, Tensor], sources: list[_Source]) -> None:
    expected = {source.name: source.shape for source in sources}
    missing = sorted(expected.keys() - published.keys())
    if missing:
        raise DataError(f"the checkpoint lacks {_listed(missing)}")
    unexpected = sorted(published.keys() - expected.keys())
    if unexpected:
        raise DataError(
            f"the checkpoint holds {_listed(unexpected)}, which this model and conditioner "
            "have no place for"
        )
    for name, shape in expected.items():
        found = tuple(published[name].shape)
        if found != shape:
            raise DataError(f"{name} has shape {found} in the checkpoint, not {shape}")


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


_RENAMES = (
    (r"^patch_embedding\.", "x_proj."),
    (r"^timestep_embedding\.", "timestep_mlp."),
    (r"^final\.modulation\.", "final_layer.adaLN_modulation.1."),
    (r"^final\.linear\.", "final_layer.linear."),
    (r"\.spatial\.", ".s_block."),
    (r"\.temporal\.", ".t_block."),
    (r"_block\.modulation\.", "_block.adaLN_modulation.1."),
    (r"_block\.qkv\.", "_block.attn.qkv_proj."),
    (r"_block\.out\.", "_block.attn.out_proj."),
    (r"_block\.mlp\.", "_block.ffwd."),
    (r"^embedder\.mlp\.", "action_embedder.mlp_in."),
    (r"^embedder\.convolutions\.0\.", "action_embedder.downsample.0."),
    (r"^embedder\.convolutions\.1\.", "action_embedder.downsample.2."),
    (r"^embedder\.out\.", "action_embedder.mlp_out.1."),
    (r"^attentions\.(\d+)\.", r"blocks.\1.action_cross_attn."),
    (r"_attn\.norm_tokens\.", "_attn.norm_q."),
    (r"_attn\.norm_context\.", "_attn.norm_kv."),
    (r"_attn\.query\.", "_attn.q_proj."),
    (r"_attn\.key_value\.", "_attn.kv_proj."),
    (r"_attn\.out\.", "_attn.out_proj."),
)
"""Patterns that turn our parameter names into the published ones, applied in this order."""


def _sources(module: nn.Module) -> dict[str, _Source]:
    """The source of every entry of the module's state dict."""
    sources: dict[str, _Source] = {}
    for name, tensor in module.state_dict().items():
        shape, change = tuple(tensor.shape), _same
        if isinstance(module, DiT) and name == "patch_embedding.weight":
            shape = (module.width, module.latent_channels, module.patch_size, module.patch_size)
            change = _flatten_patch
        elif isinstance(module, DiT) and name.endswith(".qkv.weight"):
            change = functools.partial(_part_pairs, heads=module.heads)
        sources[name] = _Source(_published_name(name), shape, change)
    return sources


def _published_name(name: str) -> str:
    for pattern, replacement in _RENAMES:
        name = re.sub(pattern, replacement, name)
    return name


def _same(tensor: Tensor) -> Tensor:
    return tensor


def _flatten_patch(kernel: Tensor) -> Tensor:
    """Turn a convolution kernel `[D, C, p, p]` into a linear layer's weight `[D, C·p·p]`."""
    return kernel.flatten(1)


def _part_pairs(qkv: Tensor, heads: int) -> Tensor:
    """Reorder rows of queries and keys from neighbouring pairs to pairs half a head apart."""
    query_key = qkv.unflatten(0, (3, heads, -1, 2))[:2]
    value = qkv.chunk(3)[2]
    return torch.cat([query_key.transpose(2, 3).flatten(0, 3), value])
