"""Shared by all sessions: the menu, the threads, and a spare stage that is ready for use."""

from __future__ import annotations

from collections.abc import Sequence

from acwm_play.stage import Stage
from acwm_play.workers import Workers
from acwm_play.worlds import World


class House:
    """Builds stages, and keeps the last one that was given back.

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
        self._spare: Stage | None = None
        self._closed = False

    def menu(self) -> list[tuple[str, str]]:
        """Names of the worlds, each with the name of its environment."""
        return [(name, world.environment) for name, world in self.worlds.items()]

    async def rehearse(self) -> None:
        """Set up the first world, so that its errors are reported before the page is served.

        Raises:
            AcwmError: the world cannot be played.
        """
        self._spare = await Stage.built(next(iter(self.worlds.values())), self.workers)

    async def stage(self, world: World) -> Stage:
        """A stage of this world, for one session.

        Raises:
            AcwmError: the world cannot be played.
        """
        spare = self._spare
        if spare is not None and spare.world == world and spare.simulator.alive:
            self._spare = None
            return spare
        return await Stage.built(world, self.workers)

    async def give_back(self, stage: Stage) -> None:
        """Take back a stage that a session has finished with."""
        kept, self._spare = (stage, None) if self._closed else (self._spare, stage)
        if kept is not None:
            await kept.close()

    async def close(self) -> None:
        """Close everything that is not in use by a session."""
        self._closed, spare, self._spare = True, self._spare, None
        if spare is not None:
            await spare.close()
        self.workers.close()
