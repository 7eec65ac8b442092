"""Shared by all sessions: the menu, the threads, and a spare world that is ready for use."""

from __future__ import annotations

from collections.abc import Sequence

from acwm_play.live_world import LiveWorld
from acwm_play.simulator import SceneSpec
from acwm_play.workers import Workers
from acwm_play.worlds import World


class WorldPool:
    """Starts worlds, and keeps the last one that was given back.

    A page that is reloaded, or reconnects after its connection broke, can therefore go on at once.

    Args:
        worlds: worlds in the menu, at least one.
        steps: sampling steps; the models' own numbers by default.

    Attributes:
        worlds: worlds by name.
        workers: the threads.
    """

    def __init__(self, worlds: Sequence[World], steps: int | None = None) -> None:
        self.worlds = {world.name: world for world in worlds}
        self.workers = Workers(steps)
        self._spare: LiveWorld | None = None
        self._closed = False

    def menu(self) -> list[tuple[str, str]]:
        """Names of the worlds, each with the name of its environment."""
        return [(name, world.environment) for name, world in self.worlds.items()]

    async def warm_up(self) -> None:
        """Set up the first world and a scene of it before the page is served.

        So errors are reported at once, and the page has pictures as soon as it is open.
        """
        self._spare = await LiveWorld.create(next(iter(self.worlds.values())), self.workers)
        await self._spare.begin(SceneSpec(0))

    async def acquire(self, world: World) -> LiveWorld:
        """A running world, for one session."""
        spare = self._spare
        if spare is not None and spare.world == world and spare.simulator.alive:
            self._spare = None
            return spare
        return await LiveWorld.create(world, self.workers)

    async def release(self, live: LiveWorld) -> None:
        """Take back a world that a session has finished with."""
        surplus, self._spare = (live, None) if self._closed else (self._spare, live)
        if surplus is not None:
            await surplus.close()

    async def close(self) -> None:
        """Close everything that is not in use by a session."""
        self._closed, spare, self._spare = True, self._spare, None
        if spare is not None:
            await spare.close()
        self.workers.close()
