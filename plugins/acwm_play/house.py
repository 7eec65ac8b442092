"""What all sessions share: the menu, the threads, and a stage that is set up and waits."""

from __future__ import annotations

from collections.abc import Sequence

from acwm_play.stage import Stage
from acwm_play.workers import Workers
from acwm_play.worlds import World


class House:
    """Builds stages, and keeps the last one that was given back: a page that is loaded again, or
    comes back after its connection broke, goes on at once.

    Args:
        worlds: the menu, not empty.
        steps: sampling steps; the models' own numbers by default.

    Attributes:
        worlds: by name.
        workers: the threads.
    """

    def __init__(self, worlds: Sequence[World], steps: int | None = None) -> None:
        self.worlds = {world.name: world for world in worlds}
        self.workers = Workers(steps)
        self._spare: Stage | None = None
        self._closed = False

    def menu(self) -> list[tuple[str, str]]:
        """Names of worlds, each with that of its environment."""
        return [(name, world.environment) for name, world in self.worlds.items()]

    async def rehearse(self) -> None:
        """Set the first world up: what is wrong with it is told before a page is served.

        Raises:
            AcwmError: it cannot be played.
        """
        self._spare = await Stage.built(next(iter(self.worlds.values())), self.workers)

    async def stage(self, world: World) -> Stage:
        """One of that world, for one session.

        Raises:
            AcwmError: it cannot be played.
        """
        spare = self._spare
        if spare is not None and spare.world == world and spare.simulator.alive:
            self._spare = None
            return spare
        return await Stage.built(world, self.workers)

    async def give_back(self, stage: Stage) -> None:
        """What a session is done with."""
        kept, self._spare = (stage, None) if self._closed else (self._spare, stage)
        if kept is not None:
            await kept.close()

    async def close(self) -> None:
        """End everything that no session has."""
        self._closed, spare, self._spare = True, self._spare, None
        if spare is not None:
            await spare.close()
        self.workers.close()
