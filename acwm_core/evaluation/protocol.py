"""Protocols: which clips of which episodes are predicted. Does not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from acwm_core.errors import RecipeError, suggest
from acwm_core.plugins import catalog

if TYPE_CHECKING:
    from acwm_core.evaluation.benchmark import PublishedTable
    from acwm_core.evaluation.config import EvaluationConfig

FULL = "full"


class Protocol:
    """Chooses the test clips. This base class is the protocol ``full``: whole episodes.

    Plugins register subclasses with the hook `register_protocols`. They are constructed without
    arguments whenever a recipe is checked, so their modules should import nothing heavy.

    Attributes:
        defaults: values for settings of `EvaluationConfig` that are None.
        cuts_windows: whether it cuts several clips from an episode, `evaluation.cuts` of them.
        from_first_frame: whether every clip starts at its episode's first frame, so that its start
            can be perturbed in the simulator.
    """

    defaults: Mapping[str, Any] = {}
    cuts_windows: bool = False
    from_first_frame: bool = True

    def episodes(self, count: int, config: EvaluationConfig) -> list[int]:
        """Indices of the episodes to use, of `count` in a split, ascending; here the first ones."""
        return list(range(min(count, config.episodes or count)))

    def windows(self, length: int, config: EvaluationConfig) -> list[tuple[int, int]]:
        """The clips of an episode of `length` frames: first frame and number of frames of each."""
        return [(0, min(length, config.frames or length))]

    def tables(self) -> Mapping[str, PublishedTable]:
        """Published tables that were measured so, by name, the first to be searched first."""
        return {}


def protocol_named(name: str) -> Protocol:
    """The protocol with this name, or a `RecipeError` that suggests the closest name."""
    if name == FULL:
        return Protocol()
    registry = catalog().registry("protocol")
    if name not in registry:
        known = suggest(name, [FULL, *(component.name for component in registry)])
        raise RecipeError(f"evaluation.protocol: unknown {name!r}{known}")
    return registry[name].create_as(Protocol)
