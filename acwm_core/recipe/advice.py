"""Which overlay suits the data of a recipe: what a recipe's `advisor` says, unless one is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from acwm_core.plugins import catalog
from acwm_core.recipe.compose import OVERLAY, advisor_of, read_recipe

CHOSEN = ("model", "codec", "conditioner", "objective")
"""Components whose choice leaves an advisor nothing to say."""


class Advice(NamedTuple):
    """What suits data.

    Attributes:
        overlay: its name, without ``+``; empty for the recipe as it is.
        why: one sentence, without a full stop.
    """

    overlay: str
    why: str


Advisor = Callable[[Path], Advice | None]
"""Looks at a data folder; None if it has nothing to say of such data."""


def advised(recipe: str | Path, overrides: Sequence[str]) -> tuple[list[str], Advice | None]:
    """The overrides with the overlay that suits the data, and the advice if there is any.

    A recipe that names an `advisor` is advised unless an override is an overlay, or names one of
    `CHOSEN`, or the data is not there yet.
    """
    name = advisor_of(recipe)
    choices = [word for word in overrides if word.startswith(OVERLAY) or _names_a_part(word)]
    if name is None or choices or name not in catalog().registry("advisor"):
        return [*overrides], None
    path = read_recipe(recipe, overrides).get("data", {}).get("path")
    advisor: Advisor = catalog().component("advisor", name).load()
    advice = advisor(Path(path)) if isinstance(path, str) and Path(path).is_dir() else None
    if advice is None or not advice.overlay:
        return [*overrides], advice
    return [f"{OVERLAY}{advice.overlay}", *overrides], advice


def _names_a_part(override: str) -> bool:
    section, _, parameter = override.partition("=")[0].partition(".")
    return section in CHOSEN and parameter in ("", "name")
