"""Weights of the three models that scenes replaced, under the names that scenes have."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping

from torch import Tensor

from acwm_core.errors import AcwmWarning

PAINTERS = {
    "bodies": ("agents", "bodies", "vector", "then", "now"),
    "values": ("map", "tell", "then", "now"),
    "nodes": ("map", "look", "vector", "then", "now"),
}
"""Parts of the former `drawing` that the painter of each group has now."""


def upgraded(
    weights: dict[str, Tensor], groups: Collection[str], own: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The weights as a scene with these groups has them; those of scenes stay as they are.

    The former models had no scale of states among their weights. Where one is missing, it stays
    unknown, which is a warning: states can then not be predicted.

    Args:
        weights: by name.
        groups: names of the scene's groups.
        own: the weights that the scene has now.
    """
    if any(name.startswith("groups.") for name in weights):
        return weights
    (group,) = groups
    moved = {_renamed(name, group): values for name, values in weights.items()}
    if group == "values":
        warnings.warn(
            "these weights were saved without the scale of their states, by an earlier version: "
            "they predict video as before, but no states, and what they learnt further would have "
            "the scale of other data",
            AcwmWarning,
            stacklevel=2,
        )
    missing = {name: own[name] for name in own.keys() - moved.keys() if name.endswith(SCALES)}
    return moved | missing


SCALES = (".mean", ".std", ".zoom")
"""Buffers of groups that the former models did not save."""


def _renamed(name: str, group: str) -> str:
    part, _, rest = name.partition(".")
    if part != "drawing":
        return f"groups.{group}.{name}"
    painted = rest.partition(".")[0] in PAINTERS[group]
    return f"groups.{group}.painter.{rest}" if painted else name
