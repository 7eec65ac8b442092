"""`Protocol`: which clips of which test episodes an evaluation predicts. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from acwm_core.catalog import catalog
from acwm_core.errors import PluginError, RecipeError, suggest

if TYPE_CHECKING:
    from acwm_core.evaluation.config import EvaluationConfig

FULL = "full"


class Protocol:
    """Every test episode from its first frame to its end: the protocol ``full``.

    Plugins register subclasses by the hook `register_protocols`. They are constructed without
    arguments whenever a recipe is checked, so their modules import nothing heavy.

    Attributes:
        defaults: settings of `EvaluationConfig` that are None where nothing else is said.
        cuts_windows: whether it takes several clips of an episode, `evaluation.cuts` of them.
        from_first_frame: whether every clip begins with its episode, so that its start may be
            perturbed in the simulator.
    """

    defaults: Mapping[str, Any] = {}
    cuts_windows: bool = False
    from_first_frame: bool = True

    def episodes(self, count: int, config: EvaluationConfig) -> list[int]:
        """Which of the `count` episodes of a split are taken, in rising order; the first ones."""
        return list(range(min(count, config.episodes or count)))

    def windows(self, length: int, config: EvaluationConfig) -> list[tuple[int, int]]:
        """First frame and number of frames of the clips of an episode of `length` frames."""
        return [(0, min(length, config.frames or length))]


def protocol_named(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        RecipeError: there is none; the message has the nearest.
        PluginError: what is registered under it is no `Protocol`.
    """
    if name == FULL:
        return Protocol()
    registry = catalog().registry("protocol")
    if name not in registry:
        known = suggest(name, [FULL, *(component.name for component in registry)])
        raise RecipeError(f"evaluation.protocol: unknown {name!r}{known}")
    made: Any = registry[name].create()
    if not isinstance(made, Protocol):
        raise PluginError(f"protocol {name!r} makes a {type(made).__name__}, which is no Protocol")
    return made
