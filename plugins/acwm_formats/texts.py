"""Texts in recordings, such as tasks and instructions, which are kept as facts of episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

LONGEST = 1000
"""Characters of a text that is kept."""

MOST = 1000
"""Texts that are kept of an episode under one name."""

Fact = str | list[str]
"""The text of an episode; a list if it changes, of each once."""


def text_fact(values: Iterable[Any]) -> Fact | None:
    """What some values say; None if they are no texts, or no short ones.

    Bytes are texts in UTF-8. Empty texts, and what stands for a missing one, say nothing.
    """
    texts: dict[str, None] = {}
    for value in values:
        if value is None or (isinstance(value, float) and np.isnan(value)):
            continue
        if not isinstance(value, str | bytes):
            return None
        try:
            text = value.decode() if isinstance(value, bytes) else str(value)
        except UnicodeDecodeError:
            return None
        if len(text) > LONGEST:
            return None
        if text.strip():
            texts[text] = None
    kept = list(texts)[:MOST]
    return kept[0] if len(kept) == 1 else kept or None


def text_facts(values: Mapping[str, Iterable[Any]]) -> dict[str, Fact]:
    """The facts by name; without what is no text."""
    facts = {name: text_fact(texts) for name, texts in values.items()}
    return {name: fact for name, fact in facts.items() if fact is not None}


def text_note(facts: Iterable[str]) -> list[str]:
    """A sentence for people about texts that were kept; none if there are none."""
    names = ", ".join(facts)
    kept = f"Texts were kept as facts of the episodes: {names}. No model reads them."
    return [kept] if names else []
