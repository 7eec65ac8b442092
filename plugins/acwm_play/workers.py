"""Worker threads: one for all models, one for instruments, one for files.

With more threads than cores, several tabs would only wait for each other in another order.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, ParamSpec, TypeVar

from acwm_core.environment import EnvironmentCard
from acwm_core.world_model import WorldModel
from acwm_play.dream import Dream
from acwm_play.worlds import World, load

P = ParamSpec("P")
T = TypeVar("T")

Where = Literal["model", "instruments", "disk"]


class Workers:
    """The threads and the loaded models.

    Args:
        steps: sampling steps of models; their own numbers by default.
    """

    def __init__(self, steps: int | None = None) -> None:
        names: tuple[Where, ...] = ("model", "instruments", "disk")
        self._pools = {name: ThreadPoolExecutor(1, f"acwm-play-{name}") for name in names}
        self._steps = steps
        self._models: dict[str, WorldModel] = {}

    async def run(self, where: Where, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """Run `work` in one of the threads, after the work already queued there."""
        pool, loop = self._pools[where], asyncio.get_running_loop()
        return await loop.run_in_executor(pool, lambda: work(*args, **more))

    def dream(self, world: World, card: EnvironmentCard) -> Dream:
        """Create a stream of a world's model.

        Raises:
            AcwmError: the model cannot be loaded, or cannot be played in this environment.
        """
        return Dream(self._model(world), card, self._steps)

    def _model(self, world: World) -> WorldModel:
        key = str(world.run)
        if key not in self._models:
            self._models[key] = load(world).world_model
        return self._models[key]

    def close(self) -> None:
        """End the threads once their current work is done."""
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)
