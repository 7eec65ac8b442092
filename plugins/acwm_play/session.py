"""One tab: a simulator and a model that get the same actions, controlled by a person.

A model predicts latent frames, each of which needs the actions of several video frames. So the
simulator's frames are held back until the model has predicted the same frames, and both are shown
together: the two pictures always show the same moment, one latent frame (0.4 s) after the action.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import AcwmError, is_for_users, sentence
from acwm_play import messages
from acwm_play.action_source import PERSON, ActionSource
from acwm_play.clock import SPEEDS, Clock
from acwm_play.figures import pixel_error
from acwm_play.live_world import LiveWorld
from acwm_play.messages import Outbox, Wish, pack
from acwm_play.pool import WorldPool
from acwm_play.recorder import MAX_FRAMES, Recording, save
from acwm_play.simulator import Scene, TimeStep

REST = 2.0
"""How long instruments pause, relative to the time they worked, because frames come first."""


class Session:
    """Plays until it is cancelled; all messages for the page go to its `outbox`.

    Args:
        pool: shared by all sessions.
        out: folder for recordings.
        more: event that is set whenever something was put into the outbox.
    """

    def __init__(self, pool: WorldPool, out: Path, more: asyncio.Event) -> None:
        self._pool, self._out, self._more = pool, out, more
        self.outbox = Outbox()
        self._clock = Clock(10)
        self._source = ActionSource(self._tell)
        self._live: LiveWorld | None = None
        self._wanted: messages.Open | None = None
        self._take_over = False
        self._last: tuple[TimeStep, NDArray[np.uint8]] | None = None
        self._alone = 0
        self._recording: Recording | None = None
        self._keep_recording = False
        self._predicting: asyncio.Task[None] | None = None
        self._reading: asyncio.Task[None] | None = None
        self._floor_of: Scene | None = None
        self._floors: dict[str, float | None] = {}
        self._pace = 0.0
        self._step = False
        self._wake = asyncio.Event()

    # Messages from the page --------------------------------------------------------------------

    def wish(self, wish: Wish) -> None:
        """Note what the page asks for; the loop acts on it with the next frame."""
        if isinstance(wish, messages.Act | messages.Point):
            self._source.hold(wish)
        else:
            self._note(wish)
            self._wake.set()
            self._tell_state()

    def _note(self, wish: Wish) -> None:
        match wish:
            case messages.Open():
                self._wanted = wish
            case messages.TakeOver():
                self._take_over = True
            case messages.Pause(on):
                self._clock.paused = on
            case messages.Step():
                self._step = True
            case messages.Speed(value) if value in SPEEDS:
                self._clock.speed = value
            case messages.Drive(by, task):
                self._source.hand_to(by, task)
            case messages.Record(on):
                self._keep_recording = on
            case _:
                pass

    # The loop ----------------------------------------------------------------------------------

    async def run(self) -> None:
        """Play one scene after another, as the page asks for them."""
        try:
            while self._wanted is None:
                await self._asked()
            while True:
                try:
                    await self._go_on()
                except Exception as error:
                    if not is_for_users(error):
                        raise
                    self._tell("notice", text=sentence(error), wrong=True)
                    self._predicting = None
                    self._source.stop()
                    await self._save()
                    while self._wanted is None:
                        await self._asked()
        finally:
            await asyncio.shield(self._close())

    async def _go_on(self) -> None:
        """Do the next thing: what the page asks for, or the next latent frame."""
        if self._wanted is not None or self._live is None:
            await self._open(self._wanted or messages.Open())
        elif self._take_over:
            await self._start_over()
        elif self._keep_recording != (self._recording is not None):
            await self._settled()
            await self._heed_recording()
        elif not await self._ready(self._live):
            pass  # it was waited for, and the page may have asked for something
        elif (self._clock.paused and not self._step) or self._source.over:
            await self._asked()
        else:
            await self._latent_frame(self._live)

    async def _asked(self) -> None:
        """Wait until the page asks for something."""
        self._wake.clear()
        await self._wake.wait()

    async def _open(self, wanted: messages.Open) -> None:
        self._wanted, self._take_over = None, False
        self._source.stop()
        with contextlib.suppress(Exception):  # it was shown
            await self._settled()
        await self._save()
        live, before = await self._set_up(wanted.world)
        factors = wanted.factors
        scene = Scene.drawn(factors) if wanted.index is None else Scene(wanted.index, factors)
        try:
            time_step, seen = await live.begin(scene)
        except Exception as error:
            if before is None or not is_for_users(error):
                raise
            self._tell("notice", text=sentence(error), wrong=True)
            time_step, seen = await live.begin(before)  # the last scene that worked
        self._source.begin(live)
        self.outbox.forget_frames()
        resting = await live.resting()
        self._tell("world", **live.about(time_step), **resting, menu=self._pool.menu())
        self._began(time_step, seen)

    async def _set_up(self, name: str | None) -> tuple[LiveWorld, Scene | None]:
        """A running world (by default the same one), and the scene that it currently shows."""
        live = self._live
        world = self._pool.worlds.get(name or "") or (live.world if live else None)
        world = world or next(iter(self._pool.worlds.values()))
        if live is not None and live.world == world and live.simulator.alive:
            return live, live.scene
        self._tell("busy", text=f"Setting up {world.name} …")
        self._live = None
        if live is not None:
            await self._pool.release(live)
        made = await self._pool.acquire(world)
        self._live, self._clock.fps = made, made.simulator.card.fps
        return made, None

    async def _start_over(self) -> None:
        assert self._live is not None
        self._take_over = False
        await self._settled()
        self._began(self._live.recent[-1], await self._live.take_over())

    def _began(self, time_step: TimeStep, seen: NDArray[np.uint8]) -> None:
        """Show the start, where simulator and model show the same."""
        self._last, self._alone = (time_step, seen), 0
        self._show([time_step], seen[None], [self._source.seq])
        self._tell_state()

    async def _latent_frame(self, live: LiveWorld) -> None:
        """Simulate one latent frame; the model predicts it while the next one is simulated."""
        self._step = False
        time_steps: list[TimeStep] = []
        seqs: list[int] = []
        began = time.monotonic()
        while len(time_steps) < live.dream.stride:
            await self._clock.tick()
            if self._wanted is not None:
                return
            if await self._ready(live):
                seqs.append(self._source.seq)
                time_steps.append(await self._source.act(live))
        await self._settled()
        self._pace = (time.monotonic() - began) / len(time_steps)
        self._predicting = asyncio.create_task(self._predict(live, time_steps, seqs))

    async def _settled(self) -> None:
        """Wait until the running prediction has ended.

        Raises:
            AcwmError: the model failed.
        """
        task, self._predicting = self._predicting, None
        if task is not None:
            await task

    async def _predict(self, live: LiveWorld, time_steps: list[TimeStep], seqs: list[int]) -> None:
        seen = await live.predict([time_step.action for time_step in time_steps])
        self._alone += len(time_steps)
        if self._recording:
            self._recording.time_steps += time_steps
            self._recording.dreamt += [*seen]
            if self._recording.frames >= MAX_FRAMES:
                self._keep_recording = False
        self._last = time_steps[-1], seen[-1]
        self._show(time_steps, seen, seqs)
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._read(live, time_steps[-1], seen[-1]))

    async def _ready(self, live: LiveWorld) -> bool:
        """Whether the next action is known; if not, wait until a driver has planned it."""
        try:
            return await self._source.ready(live, self._wake)
        except Exception as error:
            if not is_for_users(error):
                raise
            self._tell("notice", text=sentence(error), wrong=True)
            self._tell_state()
            return False

    # Messages to the page ----------------------------------------------------------------------

    def _tell(self, kind: Any, /, **values: Any) -> None:
        self.outbox.put(kind, **values)
        self._more.set()

    def _tell_state(self) -> None:
        self._tell(
            "state",
            paused=self._clock.paused,
            speed=self._clock.speed,
            driver=self._source.driver,
            recording=self._keep_recording,
        )

    def _show(self, time_steps: list[TimeStep], seen: NDArray[np.uint8], seqs: list[int]) -> None:
        live, progress = self._live, time_steps[-1].progress
        assert live is not None
        header = {
            "seqs": seqs,
            "alone": self._alone / live.simulator.card.fps,
            "pace": self._pace,
            "pixel_error": pixel_error(seen[-1], time_steps[-1].frame),
            "spread": live.dream.spread,
            "dropped": self.outbox.dropped,
            "recorded": self._recording.frames if self._recording else 0,
            "progress": dataclasses.asdict(progress) if progress else None,
            "places": None if self._source.driver == PERSON else live.places(time_steps[-1].action),
        }
        self.outbox.put_frames(pack(header, np.stack([m.frame for m in time_steps]), seen))
        self._more.set()

    async def _read(self, live: LiveWorld, time_step: TimeStep, seen: NDArray[np.uint8]) -> None:
        alone, scene, began = self._alone / live.simulator.card.fps, live.scene, time.monotonic()
        floor = scene is not self._floor_of
        run = self._pool.workers.run
        try:
            read = await run("instruments", live.instruments.read, seen, time_step, floor)
        except Exception as error:
            if not is_for_users(error):
                raise
            self._tell("notice", text=sentence(error), wrong=True)
            return
        if live is self._live and scene is live.scene:
            self._floor_of, self._floors = scene, read.floors or self._floors
            self._tell("figures", alone=alone, **{**read._asdict(), "floors": self._floors})
        await asyncio.sleep(REST * (time.monotonic() - began))

    # Recordings --------------------------------------------------------------------------------

    async def _heed_recording(self) -> None:
        """Start or end a recording, between latent frames."""
        if self._keep_recording and self._recording is None and self._last is not None:
            self._recording = Recording([self._last[0]], [self._last[1]])
        elif not self._keep_recording:
            await self._save()

    async def _save(self) -> None:
        """Save the recording of this scene; recording continues with the next scene."""
        recording, self._recording = self._recording, None
        if recording is None or self._live is None or recording.frames < 2:
            return
        card = self._live.simulator.card
        try:
            saved = await self._pool.workers.run("disk", save, recording, card, self._out)
        except (AcwmError, OSError) as error:
            self._keep_recording = False
            self._tell("notice", text=f"Not saved: {error}", wrong=True)
        else:
            folder, index, video = saved
            seconds = (recording.frames - 1) / card.fps
            text = f"Saved {seconds:.1f} s as episode {index} of {folder}, and as {video}"
            self._tell("notice", text=text, wrong=False)
        self._tell_state()

    async def _close(self) -> None:
        self._source.stop()
        for task in (self._predicting, self._reading):
            if task:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, AcwmError):
                    await task
        await self._save()
        if self._live:
            await self._pool.release(self._live)
