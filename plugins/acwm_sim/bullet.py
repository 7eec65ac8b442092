"""PyBullet without its console output: one client per episode, the same settings everywhere."""

import contextlib
import functools
import os
import sys
from collections.abc import Generator
from typing import Any


@contextlib.contextmanager
def _silence() -> Generator[None]:
    """Drop what C code prints: PyBullet prints on import, and stdout may carry data."""
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
    """A separate physics world with PyBullet's functions as methods.

    Creating a new world takes a millisecond and is the only way to bit-identical results: a reset
    world keeps the order of its collision pairs and the warm start of its solver.

    Args:
        timestep: seconds per step.
        iterations: constraint solver iterations per step.
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
        """Free the world. It cannot be used afterwards."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
