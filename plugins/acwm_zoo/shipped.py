"""The models that ship: a folder each, with the files of a run that prediction needs."""

from __future__ import annotations

import re
from pathlib import Path

MODELS = Path(__file__).with_name("models")


def shipped() -> list[str]:
    """Their names."""
    return sorted(file.parent.name for file in MODELS.glob("*/recipe.yaml"))


def folder(model: str) -> Path:
    """The folder of the model of that name."""
    return MODELS / model


def about(model: str) -> str:
    """The first line of its card, as a phrase."""
    card = (MODELS / model / "README.md").read_text(encoding="utf-8")
    title = re.search(r"^# (.+)$", card, re.MULTILINE)
    return title[1] if title else ""
