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
from acwm_play.action_source import PERSON, POLICY, ActionSource
from acwm_play.clock import SPEEDS, Clock
from acwm_play.figures import pixel_error
from acwm_play.live_world import LiveWorld
from acwm_play.messages import Outbox, PageMessage, pack
from acwm_play.pool import WorldPool
from acwm_play.recorder import MAX_FRAMES, PlayedEpisode, save
from acwm_play.simulator import SceneSpec, TimeStep

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
        self._request: messages.Open | None = None
        self._take_over = self._redraw = False
        self._moves: dict[int, list[float]] = {}
        self._last: tuple[TimeStep, NDArray[np.uint8]] | None = None
        self._alone = 0
        self._recording: PlayedEpisode | None = None
        self._keep_recording = False
        self._predicting: asyncio.Task[None] | None = None
        self._measuring: asyncio.Task[None] | None = None
        self._floor_scene: SceneSpec | None = None
        self._floors: dict[str, float | None] = {}
        self._pace = 0.0
        self._step = False
        self._wake = asyncio.Event()

    # Messages from the page --------------------------------------------------------------------

    def receive(self, message: PageMessage) -> None:
        """Note what the page asks for; the loop acts on it with the next frame."""
        if isinstance(message, messages.Act | messages.Point):
            self._source.hold(message)
        elif isinstance(message, messages.Move):
            self._moves[message.number] = message.place
        else:
            self._note(message)
            self._wake.set()
            self._tell_state()

    def _note(self, message: PageMessage) -> None:
        match message:
            case messages.Open():
                self._request = message
            case messages.TakeOver():
                self._take_over = True
            case messages.Redraw():
                self._take_over = self._redraw = True
            case messages.Pause(on):
                self._clock.paused = on
            case messages.Step():
                self._step = True
            case messages.Speed(value) if value in SPEEDS:
                self._clock.speed = value
            case messages.Drive(by, task):
                self._source.hand_to(by, task)
                apart = self._live is not None and self._live.apart
                self._take_over |= by == POLICY and apart  # so that both can be compared again
            case messages.Record(on):
                self._keep_recording = on
            case _:
                pass

    # The loop ----------------------------------------------------------------------------------

    async def run(self) -> None:
        """Play one scene after another, as the page asks for them."""
        try:
            while self._request is None:
                await self._wait_for_page()
            while True:
                try:
                    await self._advance()
                except Exception as error:
                    if not is_for_users(error):
                        raise
                    self._tell("notice", text=sentence(error), wrong=True)
                    self._predicting = None
                    self._source.stop()
                    await self._save()
                    while self._request is None:
                        await self._wait_for_page()
        finally:
            await asyncio.shield(self._close())

    async def _advance(self) -> None:
        """Do the next thing: what the page asks for, or the next latent frame."""
        if self._request is not None or self._live is None:
            await self._open(self._request or messages.Open())
        elif self._take_over:
            await self._restart_model()
        elif self._keep_recording != (self._recording is not None):
            await self._end_prediction()
            await self._follow_recording()
        elif not await self._ready(self._live):
            pass  # it was waited for, and the page may have asked for something
        elif (self._clock.paused and not self._step) or self._source.over:
            await self._wait_for_page()
        else:
            await self._latent_frame(self._live)

    async def _wait_for_page(self) -> None:
        """Wait until the page asks for something."""
        self._wake.clear()
        await self._wake.wait()

    async def _open(self, request: messages.Open) -> None:
        self._request, self._take_over, self._redraw = None, False, False
        self._source.stop()
        with contextlib.suppress(Exception):  # it was shown
            await self._end_prediction()
        await self._save()
        live, before = await self._acquire(request.world)
        factors = request.factors
        scene = (
            SceneSpec.draw(factors) if request.index is None else SceneSpec(request.index, factors)
        )
        try:
            time_step, frame = await live.begin(scene)
        except Exception as error:
            if before is None or not is_for_users(error):
                raise
            self._tell("notice", text=sentence(error), wrong=True)
            time_step, frame = await live.begin(before)  # the last scene that worked
        self._source.begin(live)
        self.outbox.forget_frames()
        rest = await live.rest()
        self._tell("world", **live.about(time_step), **rest, menu=self._pool.menu())
        self._show_start(time_step, frame)

    async def _acquire(self, name: str | None) -> tuple[LiveWorld, SceneSpec | None]:
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
        acquired = await self._pool.acquire(world)
        self._live, self._clock.fps = acquired, acquired.simulator.card.fps
        return acquired, None

    async def _restart_model(self) -> None:
        assert self._live is not None
        await self._end_prediction()
        self._live.model.draw += self._redraw
        self._take_over = self._redraw = False
        self._show_start(self._live.recent[-1], await self._live.take_over())

    def _show_start(self, time_step: TimeStep, frame: NDArray[np.uint8]) -> None:
        """Show the start, where simulator and model show the same."""
        self._last, self._alone, self._moves = (time_step, frame), 0, {}
        self._show([time_step], frame[None], [self._source.seq])
        self._tell_state()

    async def _latent_frame(self, live: LiveWorld) -> None:
        """Simulate one latent frame; the model predicts it while the next one is simulated."""
        self._step = False
        time_steps: list[TimeStep] = []
        seqs: list[int] = []
        start = time.monotonic()
        while len(time_steps) < live.model.stride:
            await self._clock.tick()
            if self._request is not None:
                return
            if await self._ready(live):
                seqs.append(self._source.seq)
                time_steps.append(await self._source.act(live))
        await self._end_prediction()
        self._pace = (time.monotonic() - start) / len(time_steps)
        self._predicting = asyncio.create_task(self._predict(live, time_steps, seqs))

    async def _end_prediction(self) -> None:
        """Wait until the running prediction has ended."""
        task, self._predicting = self._predicting, None
        if task is not None:
            await task

    async def _predict(self, live: LiveWorld, time_steps: list[TimeStep], seqs: list[int]) -> None:
        moves, self._moves = self._moves, {}
        for number, place in moves.items():
            await live.move(number, place)
        frames = await live.predict([time_step.action for time_step in time_steps])
        self._alone += len(time_steps)
        if self._recording:
            self._recording.time_steps += time_steps
            self._recording.model_frames += [*frames]
            if self._recording.frames >= MAX_FRAMES:
                self._keep_recording = False
        self._last = time_steps[-1], frames[-1]
        self._show(time_steps, frames, seqs)
        if self._measuring is None or self._measuring.done():
            self._measuring = asyncio.create_task(self._measure(live, time_steps[-1], frames[-1]))

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

    def _show(self, time_steps: list[TimeStep], frames: NDArray[np.uint8], seqs: list[int]) -> None:
        live, progress = self._live, time_steps[-1].progress
        assert live is not None
        header = {
            "seqs": seqs,
            "alone": self._alone / live.simulator.card.fps,
            "pace": self._pace,
            "pixel_error": None if live.apart else pixel_error(frames[-1], time_steps[-1].frame),
            "spread": live.model.spread,
            "keypoints": live.model.keypoints,
            "dropped": self.outbox.dropped,
            "recorded": self._recording.frames if self._recording else 0,
            "progress": dataclasses.asdict(progress) if progress else None,
            "places": None if self._source.driver == PERSON else live.places(time_steps[-1].action),
        }
        doubt = live.model.doubt
        header["doubt"] = doubt is not None
        simulated = np.stack([m.frame for m in time_steps])
        self.outbox.put_frames(pack(header, simulated, frames, *([] if doubt is None else [doubt])))
        self._more.set()

    async def _measure(self, live: LiveWorld, truth: TimeStep, frame: NDArray[np.uint8]) -> None:
        alone, scene, start = self._alone / live.simulator.card.fps, live.scene, time.monotonic()
        floor = scene is not self._floor_scene
        run = self._pool.workers.run
        try:
            figures = await run("instruments", live.instruments.measure, frame, truth, floor)
        except Exception as error:
            if not is_for_users(error):
                raise
            self._tell("notice", text=sentence(error), wrong=True)
            return
        if live is self._live and scene is live.scene:
            self._floor_scene, self._floors = scene, figures.floors or self._floors
            self._tell("figures", alone=alone, **{**figures._asdict(), "floors": self._floors})
        await asyncio.sleep(REST * (time.monotonic() - start))

    # Recordings --------------------------------------------------------------------------------

    async def _follow_recording(self) -> None:
        """Start or end a recording, between latent frames."""
        if self._live is not None and self._live.recorded:
            self._keep_recording = False
            text = "Not saved: the model has a recording beside it, not a simulator"
            self._tell("notice", text=text, wrong=True)
            self._tell_state()
        elif self._keep_recording and self._recording is None and self._last is not None:
            self._recording = PlayedEpisode([self._last[0]], [self._last[1]])
        elif not self._keep_recording:
            await self._save()

    async def _save(self) -> None:
        """Save the recording of this scene; recording continues with the next scene."""
        recording, self._recording = self._recording, None
        if recording is None or self._live is None or recording.frames < 2:
            return
        card = self._live.simulator.card
        try:
            run = self._pool.workers.run
            folder, index, video = await run("disk", save, recording, card, self._out)
        except (AcwmError, OSError) as error:
            self._keep_recording = False
            self._tell("notice", text=f"Not saved: {error}", wrong=True)
        else:
            seconds = (recording.frames - 1) / card.fps
            text = f"Saved {seconds:.1f} s as episode {index} of {folder}, and as {video}"
            self._tell("notice", text=text, wrong=False)
        self._tell_state()

    async def _close(self) -> None:
        self._source.stop()
        for task in (self._predicting, self._measuring):
            if task:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, AcwmError):
                    await task
        await self._save()
        if self._live:
            await self._pool.release(self._live)
