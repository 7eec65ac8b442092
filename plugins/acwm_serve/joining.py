"""Streams of several clients as one, so that one forward pass serves them all.

A running stream is a tree of tensors that begin with the axis of clips, inside lists, maps, objects
and closures. Streams are alike if they agree in everything else: the same shapes, the same number
of steps where a model counts them. Alike streams are joined by joining their tensors.
"""

from __future__ import annotations

import copy
import types
from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

T = TypeVar("T")


class Joiner:
    """Joins streams of one model and takes them apart again.

    Args:
        shared: what streams refer to and do not change, such as the model.
    """

    def __init__(self, shared: Collection[object]) -> None:
        self._shared = {id(part) for part in shared}
        self._kept = shared  # so that no identity is given to something else

    def kind(self, stream: object) -> Hashable:
        """Equal for streams that can be joined."""
        facts: list[Hashable] = []

        def note(leaf: Any) -> Any:
            facts.append((leaf.shape[1:], leaf.dtype) if isinstance(leaf, Tensor) else "noise")
            return leaf

        self._walk(stream, note, facts.append)
        return tuple(facts)

    @torch.inference_mode()
    def joined(self, streams: Sequence[T]) -> T:
        """One stream of the clips of alike streams, in their order."""
        parts = [self._leaves(stream) for stream in streams]
        whole = iter([_chained(leaves) for leaves in zip(*parts, strict=True)])
        return self._walk(streams[0], lambda _: next(whole), _ignore)

    @torch.inference_mode()
    def parted(self, stream: T, clips: int) -> list[T]:
        """A stream for each of the clips."""

        def taken(row: int) -> Callable[[Any], Any]:
            def take(leaf: Any) -> Any:
                if len(leaf) != clips:
                    return leaf
                # Cloned, because a view would keep all clips in memory.
                return leaf[row : row + 1].clone() if isinstance(leaf, Tensor) else [leaf[row]]

            return take

        return [self._walk(stream, taken(row), _ignore) for row in range(clips)]

    def _leaves(self, stream: object) -> list[Any]:
        leaves: list[Any] = []
        self._walk(stream, lambda leaf: leaves.append(leaf) or leaf, _ignore)
        return leaves

    def _walk(self, thing: Any, leaf: Callable[[Any], Any], fact: Callable[[Any], None]) -> Any:
        """A copy of `thing` with other leaves: tensors, and lists of generators of noise."""

        def inside(part: Any) -> Any:
            return self._walk(part, leaf, fact)

        if id(thing) in self._shared:
            return thing
        if (isinstance(thing, Tensor) and thing.ndim) or _are_generators(thing):
            return leaf(thing)
        if isinstance(thing, (list, tuple)):
            fact(len(thing))
            parts = [inside(part) for part in thing]
            return type(thing)(*parts) if hasattr(thing, "_fields") else type(thing)(parts)
        if isinstance(thing, dict):
            fact((*thing,))
            return {key: inside(value) for key, value in thing.items()}
        if isinstance(thing, types.FunctionType):
            fact(thing.__code__)
            return _with_closure(thing, inside)
        if not hasattr(thing, "__dict__") or isinstance(thing, type):
            fact(thing if isinstance(thing, Hashable) else id(thing))
            return thing
        fact(type(thing))
        return _copied(thing, inside)


def _copied(thing: Any, inside: Callable[[Any], Any]) -> Any:
    """A copy of an object with copied attributes; a network's own weights stay shared."""
    other, own = copy.copy(thing), isinstance(thing, nn.Module)
    for name in sorted(vars(thing)):
        if not (own and isinstance(vars(thing)[name], dict)):
            other.__dict__[name] = inside(vars(thing)[name])
    return other


def _with_closure(function: types.FunctionType, inside: Callable[[Any], Any]) -> Any:
    cells = function.__closure__
    if cells is None:
        return function
    closure = tuple(types.CellType(inside(cell.cell_contents)) for cell in cells)
    code, name = function.__code__, function.__name__
    return types.FunctionType(code, function.__globals__, name, function.__defaults__, closure)


def _are_generators(thing: Any) -> bool:
    several = isinstance(thing, (list, tuple)) and bool(thing)
    return several and all(isinstance(generator, torch.Generator) for generator in thing)


def _chained(leaves: Sequence[Any]) -> Any:
    if isinstance(leaves[0], Tensor):
        return torch.cat(list(leaves))
    return [generator for leaf in leaves for generator in leaf]


def _ignore(_: object) -> None:
    pass
