"""Timing of frames: real time or slower."""

from __future__ import annotations

import asyncio
import time

SPEEDS = (1.0, 0.5, 0.25)
"""Speeds that can be chosen, relative to real time."""


class Clock:
    """Ticks `fps` times a second at full speed; a late tick delays all later ones.

    While paused, it does not make callers wait, so that work in progress ends at once.

    Args:
        fps: frames per second of the world.

    Attributes:
        speed: one of `SPEEDS`.
        paused: whether the clock is paused.
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
