"""When the next frame is due: real time or slower."""

from __future__ import annotations

import asyncio
import time

SPEEDS = (1.0, 0.5, 0.25)
"""Slow motion that can be chosen."""


class Clock:
    """Ticks `fps` times a second at full speed; a tick that comes late delays those after it.

    While it is paused it does not make anybody wait: whoever is in the middle of something ends it
    at once.

    Args:
        fps: of the world.

    Attributes:
        speed: one of `SPEEDS`.
        paused: whether it stands still.
    """

    def __init__(self, fps: float) -> None:
        self.fps, self.speed, self.paused = fps, 1.0, False
        self._due = time.monotonic()

    async def tick(self) -> None:
        """Wait until the next frame is due."""
        now, interval = time.monotonic(), 1 / (self.fps * self.speed)
        if self.paused:
            self._due = now
            return
        self._due = min(max(self._due + interval, now), now + interval)
        await asyncio.sleep(self._due - now)
