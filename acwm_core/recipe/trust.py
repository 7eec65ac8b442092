"""Code that a person names as ``module:name``."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from acwm_core.errors import RecipeError, noting


def import_named(name: str, asked: str) -> Any:
    """Import what a person typed as ``module:name``, also from the working directory.

    Args:
        name: the name.
        asked: what asks for it, for the message, e.g. ``"cost.function=mine:cost"``.

    Raises:
        RecipeError: it is not written as ``module:name``, or there is no such module or name.
    """
    module, colon, attribute = name.partition(":")
    if not (module and colon and attribute):
        raise RecipeError(f"{asked} cannot be imported: write it as module:name")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        with noting(f"in {asked}", module):
            return getattr(importlib.import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError) as error:
        raise RecipeError(f"{asked} cannot be imported: {error}") from error
    finally:
        sys.path.remove(here)
