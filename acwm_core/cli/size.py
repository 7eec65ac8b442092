"""The word for a frame size."""

from __future__ import annotations

import re
from typing import Any

import click

from acwm_core.errors import RecipeError


class FrameSize(click.ParamType[int | tuple[int, int]]):
    """``64``, or ``64x96`` for height and width."""

    name = "size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | tuple[int, int]:
        """A side, or ``(H, W)``."""
        match = re.fullmatch(r"(\d+)(?:[x×](\d+))?", str(value))
        if match is None:
            raise RecipeError(
                f"--size {value}: give a side such as 64, or HEIGHTxWIDTH such as 64x96"
            )
        height, width = match.groups()
        return (int(height), int(width)) if width else int(height)


SIZE = FrameSize()
