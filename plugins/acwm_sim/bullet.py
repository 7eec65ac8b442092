"""PyBullet without its noise: one client per episode, the same settings everywhere."""

import contextlib
import functools
import os
import sys
from collections.abc import Generator
from typing import Any


@contextlib.contextmanager
def _silence() -> Generator[None]:
    """Drop what C code prints: PyBullet greets on import, and stdout may be data."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(stream, os.dup(stream)) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream, _ in kept:
            os.dup2(nowhere, stream)
        yield
    finally:
        for stream, copy in kept:
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


with _silence():
    import pybullet

__all__ = ["GRAVITY", "Bullet", "pybullet"]

GRAVITY = 9.81
"""Metres per second squared, along −z."""


class Bullet:
    """A physics world of its own; PyBullet's functions are its methods.

    A fresh world takes a millisecond and is the only way to the same bits every time: a reset one
    keeps the order of its pairs and the warm start of its solver.

    Args:
        timestep: seconds.
        iterations: of the constraint solver per step.
    """

    def __init__(self, timestep: float, iterations: int = 80) -> None:
        self.timestep = timestep
        with _silence():
            self._client = pybullet.connect(pybullet.DIRECT)
        self.setGravity(0, 0, -GRAVITY)
        self.setPhysicsEngineParameter(
            fixedTimeStep=timestep, numSolverIterations=iterations, deterministicOverlappingPairs=1
        )

    def __getattr__(self, name: str) -> Any:
        function = functools.partial(getattr(pybullet, name), physicsClientId=self._client)
        setattr(self, name, function)
        return function

    def close(self) -> None:
        """Free the world. Nothing can be done with it afterwards."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
