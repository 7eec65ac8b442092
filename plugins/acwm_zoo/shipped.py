"""The trained models of acwm: one folder each, with the files that prediction needs.

Cards of all of them are here; the package acwm-models adds the files of most to acwm's own wheel.
"""

from __future__ import annotations

import re
from pathlib import Path

from acwm_core.errors import MissingExtraError

MODELS, MODEL_CARD = Path(__file__).with_name("models"), "README.md"
INSTALL = "pip install acwm-models"


def shipped() -> list[str]:
    """Names of the models whose files are here."""
    return [name for name in known() if (MODELS / name / "recipe.yaml").is_file()]


def known() -> list[str]:
    """Names of all models, also of those that acwm-models would add."""
    return sorted(card.parent.name for card in MODELS.glob(f"*/{MODEL_CARD}"))


def folder(model: str) -> Path:
    """The folder of a model.

    Raises:
        MissingExtraError: its files are not installed.
    """
    if model not in shipped():
        raise MissingExtraError(f"the files of {model} are in another package: {INSTALL}")
    return MODELS / model


def about(model: str) -> str:
    """The title of a model's card."""
    card = (MODELS / model / MODEL_CARD).read_text(encoding="utf-8", errors="replace")
    title = re.search(r"^# (.+)$", card, re.MULTILINE)
    return title[1] if title else ""
