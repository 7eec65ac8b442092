"""A world that is ready to be played: simulator, model, instruments and controls."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.task import Task
from acwm_core.plugins import catalog
from acwm_play.about import about_world, places
from acwm_play.figures import Instruments
from acwm_play.layout import controls, physics_of
from acwm_play.live_model import LiveModel
from acwm_play.process import SimulatorProcess
from acwm_play.recorded import RecordedVideo
from acwm_play.simulator import SceneSpec, TimeStep
from acwm_play.workers import Workers
from acwm_play.worlds import World, tasks_of

MEMORY = 64
"""Most frames of the past that a driver sees."""


@dataclasses.dataclass
class LiveWorld:
    """The parts of a world that is played.

    Attributes:
        world: the world that is played.
        workers: threads for model and instruments.
        simulator: the true simulator.
        model: the model.
        instruments: measure the model's frames.
        controls: description of the action's dimensions for the page.
        tasks: the world's tasks by name; empty if nobody drives towards goals.
        scene: the scene that was started last.
        recent: the simulator's last time steps in this scene, at most `MEMORY` or as many as the
            model starts from.
        apart: whether they cannot be compared, since the model got other actions than a recorded
            video beside it, or a person moved what it sees.
    """

    world: World
    workers: Workers
    simulator: SimulatorProcess | RecordedVideo
    model: LiveModel
    instruments: Instruments
    controls: list[dict[str, Any]]
    tasks: dict[str, Task]
    scene: SceneSpec
    recent: deque[TimeStep]
    apart: bool = False

    @property
    def recorded(self) -> bool:
        """Whether a recorded video stands in for the simulator."""
        return self.world.data is not None

    @classmethod
    async def create(cls, world: World, workers: Workers) -> LiveWorld:
        """Load everything that a world needs."""
        if world.data is None:
            simulator = await SimulatorProcess.launch(world.environment, world.size)
        else:
            simulator = RecordedVideo(world.data, world.size)
        card = simulator.card
        try:
            model = await workers.run("model", workers.live_model, world, card)
            instruments = await workers.run("instruments", Instruments, card)
        except BaseException:
            await asyncio.shield(simulator.close())
            raise
        layout = controls(card, physics_of(world.environment))
        tasks = tasks_of(world.environment) if catalog().registry("driver") else {}
        parts = world, workers, simulator, model, instruments, layout, tasks
        return cls(*parts, SceneSpec(0), deque(maxlen=max(MEMORY, model.given)))

    async def begin(self, scene: SceneSpec) -> tuple[TimeStep, NDArray[np.uint8]]:
        """Start a scene; returns the simulator's time step and the model's picture of it."""
        time_steps = await self.simulator.start(scene, self.model.given)
        self.recent.clear()
        self.recent.extend(time_steps)
        self.scene, self.model.draw = scene, 0
        return time_steps[-1], await self.take_over()

    async def take_over(self) -> NDArray[np.uint8]:
        """Restart the model from the simulator's last frames; returns its picture of the last."""
        self.apart = False
        given = [*self.recent][-self.model.given :]
        frames = np.stack([time_step.frame for time_step in given])
        actions = [time_step.action for time_step in given][1:]
        return await self.workers.run("model", self.model.restart, frames, actions)

    async def act(self, action: NDArray[np.float32]) -> TimeStep:
        """Advance the simulator by one frame."""
        self.apart |= self.recorded
        self.recent.append(await self.simulator.step(action))
        return self.recent[-1]

    async def act_by_policy(self, anew: bool) -> TimeStep:
        """Advance the simulator by one frame with its behaviour policy."""
        self.recent.append(await self.simulator.step_by_policy(anew))
        return self.recent[-1]

    async def move(self, number: int, place: list[float]) -> None:
        """Move something that the model sees to a place in the picture."""
        await self.workers.run("model", self.model.move, number, place)
        self.apart = True

    async def predict(self, actions: list[NDArray[np.float32]]) -> NDArray[np.uint8]:
        """The model's frames for the actions of one latent frame."""
        return await self.workers.run("model", self.model.step, actions)

    def places(self, action: NDArray[Any]) -> list[list[float]] | None:
        """The places in the picture that an action points to."""
        return places(self.simulator.pointing, action)

    async def rest(self) -> dict[str, Any]:
        """The action that means no motion, and the places in the picture that it points to."""
        still = await self.simulator.still()
        return {"rest": still.tolist(), "places": self.places(still)}

    async def close(self) -> None:
        """End the simulator."""
        await self.simulator.close()

    def about(self, time_step: TimeStep) -> dict[str, Any]:
        """Describe the world and its scene for the page."""
        card, label = self.simulator.card, time_step.ood_label
        shared = about_world(
            self.world.name, card, self.model.stride, self.controls, self.simulator.pointing
        )
        return {
            **shared,
            "recorded": self.recorded,
            "samples": self.model.samples,
            "engine": "" if self.recorded else card.engine,
            "drivers": _describe_drivers() if self.tasks else [],
            "tasks": [_describe_task(name, task) for name, task in self.tasks.items()],
            "metrics": self.instruments.about,
            "why_not": self.instruments.why_not,
            "factors": [dataclasses.asdict(factor) for factor in card.factors],
            "index": self.scene.index % self.simulator.scenes,
            "asked": dict(self.scene.factors),
            "drawn": dict(time_step.factors),
            "ood": label.split("+") if label else [],
        }


def _describe_drivers() -> list[dict[str, str]]:
    drivers = catalog().registry("driver")
    return [{"name": driver.name, "summary": driver.summary} for driver in drivers]


def _describe_task(name: str, task: Task) -> dict[str, Any]:
    facts = {"summary": task.summary, "unit": task.unit, "tolerance": float(task.tolerance)}
    return {"name": name, **facts}
