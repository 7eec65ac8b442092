"""Worker threads: for all models, for drivers that plan, for instruments and for files.

With more threads than cores, several tabs would only wait for each other in another order.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, ParamSpec, TypeVar, get_args

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Task
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import find_run
from acwm_planning.run import action_std_of
from acwm_play.driver import Driver
from acwm_play.live_model import LiveModel
from acwm_play.worlds import World

P = ParamSpec("P")
T = TypeVar("T")

ThreadName = Literal["model", "driver", "instruments", "disk"]


class Workers:
    """The threads and the loaded models.

    Args:
        steps: sampling steps of models; their own numbers by default.
    """

    def __init__(self, steps: int | None = None) -> None:
        self._pools = {
            name: ThreadPoolExecutor(1, f"acwm-play-{name}") for name in get_args(ThreadName)
        }
        self._steps = steps
        self._models: dict[tuple[ThreadName, str], WorldModel] = {}

    async def run(
        self, thread: ThreadName, work: Callable[P, T], *args: P.args, **more: P.kwargs
    ) -> T:
        """Run `work` in one of the threads, after the work already queued there."""
        pool, loop = self._pools[thread], asyncio.get_running_loop()
        return await loop.run_in_executor(pool, lambda: work(*args, **more))

    def live_model(self, world: World, card: EnvironmentCard) -> LiveModel:
        """Create a stream of a world's model."""
        return LiveModel(self._model("model", world), card, self._steps)

    def driver(self, name: str, world: World, card: EnvironmentCard, task: Task) -> Driver:
        """Create a driver of a world, with a copy of its model, because both work at once."""
        return (
            catalog()
            .component("driver", name)
            .create_as(
                Driver,
                world_model=self._model("driver", world),
                card=card,
                task=task,
                action_std=action_std_of(find_run(world.run)),
                steps=self._steps,
            )
        )

    def _model(self, thread: ThreadName, world: World) -> WorldModel:
        key = thread, str(world.run)
        if key not in self._models:
            self._models[key] = load_run(world.run).world_model
        return self._models[key]

    def close(self) -> None:
        """End the threads once their current work is done."""
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)
