"""The models shipped with acwm: one folder each, with the files that prediction needs."""

from __future__ import annotations

import re
from pathlib import Path

MODELS, MODEL_CARD = Path(__file__).with_name("models"), "README.md"


def shipped() -> list[str]:
    """Names of the shipped models."""
    folders = (file.parent for file in MODELS.glob("*/recipe.yaml"))
    return sorted(each.name for each in folders if (each / MODEL_CARD).is_file())


def folder(model: str) -> Path:
    """The folder of a shipped model."""
    return MODELS / model


def about(model: str) -> str:
    """The title of a model's card."""
    card = (MODELS / model / MODEL_CARD).read_text(encoding="utf-8", errors="replace")
    title = re.search(r"^# (.+)$", card, re.MULTILINE)
    return title[1] if title else ""
