"""The model behind the server: starts streams, and moves those of several clients together."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.pictures import to_pixels
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.env.task import Goal, Task, judged
from acwm_core.errors import (
    AcwmError,
    DataError,
    RecipeError,
    ShapeError,
    noting,
    sentence,
    suggest,
)
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.score import estimator_for
from acwm_core.model.shapes import Video
from acwm_core.model.state_stream import StateStream
from acwm_core.model.stream import Stream
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import find_run
from acwm_planning.run import action_std_of
from acwm_serve.joining import Joiner
from acwm_serve.plans import GoalPlanner, PlanRequest

Answer = dict[str, Any]
"""What a client receives: arrays by name."""

TRIAL, CLOSE = 3, 1e-4
"""Clips and steps of the trial of joined streams, and by how much pixels may differ on average.

Pixels are in [0, 1]. Single ones may differ more, as rounding grows from step to step.
"""

CHUNK = 64
"""Most latent frames of a request."""


@dataclass(frozen=True)
class Start:
    """A client's first message: the frames that a video begins with.

    Attributes:
        frames: `[K, H, W, 3]` uint8.
        actions: raw actions between them, `[K − 1, A]`.
        seed: of the model's noise.
        goal: picture of the goal, `[H, W, 3]` uint8, or None.
        want: what to send besides frames, names of `Engine.facts`.
    """

    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    seed: int
    goal: NDArray[np.uint8] | None
    want: tuple[str, ...]


@dataclass(eq=False)
class Running:
    """The video of one client."""

    stream: Stream
    states: StateStream | None
    goal: Goal | None
    want: tuple[str, ...]
    last: Tensor | None = None  # `[1, 3, H, W]` in [0, 1], for keypoints; None before the first


@dataclass(frozen=True)
class Step:
    """The raw actions of the next latent frames, `[stride, A]` each, for a video."""

    running: Running
    actions: tuple[Tensor, ...]

    @property
    def rest(self) -> Step:
        """What remains after the first of them."""
        return Step(self.running, self.actions[1:])


class Engine:
    """A trained model that serves many videos. Only one thread may use it at a time.

    Args:
        run: run folder, or the name of a trained model.
        task: task whose distance is measured, or None.
        steps: sampling steps; the model's own number by default.
        device: of the model; ``"auto"`` takes a GPU if there is one.

    Attributes:
        card: card of the environment.
        stride: actions, and frames, per latent frame.
        joins: whether videos of several clients are predicted in one forward pass.

    Raises:
        TrainingError: there is no such run.
        RecipeError: the model cannot be streamed, or there is no such task.
        DataError: no estimator can judge the task.
    """

    def __init__(
        self,
        run: str | Path,
        *,
        task: str | None = None,
        steps: int | None = None,
        device: str = "auto",
    ) -> None:
        bundle = load_run(run)
        self.card, self._steps = bundle.card, steps
        self._world = world = bundle.world_model.to(choose_device(device))
        self.stride, self.given = world.codec.temporal_stride, world.context_frames
        self._task, self._estimator = self._judges(task)
        self._action_std = action_std_of(find_run(run))
        self._joiner = Joiner([*world.modules(), world.objective])
        self.joins = self._tries_joining()

    def _judges(self, task: str | None) -> tuple[Task | None, StateEstimator | None]:
        if task is None:
            return None, None
        judge = catalog().component("environment", self.card.name).load_task(task)
        estimator = estimator_for(self.card)
        if estimator is None:
            raise DataError(
                f"no estimator reads the states of {self.card.name} from pictures, so distances to "
                "a goal are unknown: leave --task out"
            )
        return judge, estimator

    @property
    def wants(self) -> tuple[str, ...]:
        """What clients may ask for besides frames."""
        able = {
            "states": bool(self._world.state_shapes) and self._world.predicts_states,
            "keypoints": bool(self._world.keypoint_names),
            "distance": self._task is not None,
        }
        return tuple(name for name, there in able.items() if there)

    @property
    def plans(self) -> bool:
        """Whether clients may ask for plans."""
        return self._task is not None

    def facts(self) -> Answer:
        """What a client has to know, as it is sent when it connects."""
        action = self.card.action
        return {
            "environment": self.card.name,
            "frame_size": [*self.card.frame_size],
            "fps": self.card.fps,
            "given": self.given,
            "stride": self.stride,
            "actions": [*action.names],
            "units": [*action.units],
            "low": [*action.low],
            "high": [*action.high],
            "want": [*self.wants],
            "keypoints": [*self._world.keypoint_names],
            "task": self._task.name if self._task else None,
            "plans": self.plans,
            "unit": self._task.unit if self._task else None,
        }

    def read_start(self, message: Mapping[str, Any]) -> Start:
        """Check a client's first message.

        Raises:
            ShapeError, RecipeError: a value is missing or wrong.
        """
        _check_names(message, "a start", ("frames", "actions", "seed", "goal", "want"))
        between = message.get("actions", np.zeros((0, self.card.action.size), np.float32))
        seed, want = _seed(message), message.get("want", [])
        for name in want if isinstance(want, list) else [want]:
            if name not in self.wants:
                has = ", ".join(self.wants) or "nothing besides frames"
                raise RecipeError(f"want={name!r:.40}: this server gives {has}")
        goal = message.get("goal")
        if ("distance" in want) != (goal is not None):
            raise RecipeError("a distance needs a goal: give a picture `goal` and want distance")
        if goal is not None:
            goal = self._picture("goal", goal, self.card.frame_size)
        frames = self._picture("frames", message.get("frames"), (self.given, *self.card.frame_size))
        actions = self._actions(between, self.given - 1)
        return Start(frames, actions.numpy(), seed, goal, tuple(want))

    def planner(self) -> GoalPlanner:
        """The planner of a new session.

        Raises:
            RecipeError: the server has no task.
        """
        if self._task is None or self._estimator is None:
            raise RecipeError("this server does not plan: start it with --task")
        parts = self._world, self.card, self._task, self._estimator
        return GoalPlanner(*parts, self._action_std)

    def read_plan(self, message: Mapping[str, Any], planner: GoalPlanner) -> PlanRequest:
        """Check a client's question for actions.

        Raises:
            ShapeError, RecipeError: a value is missing or wrong.
        """
        _check_names(message, "a plan", ("observed", "actions", "goal", "still", "seed"))
        observed, spec = message["observed"], self.card.action
        count = len(observed) if isinstance(observed, np.ndarray) and observed.ndim == 4 else 1
        if not 1 <= count <= CHUNK * self.stride:
            raise ShapeError(f"observed: 1 to {CHUNK * self.stride} frames, not {count}")
        frames = self._picture("observed", observed, (count, *self.card.frame_size))
        rows = message.get("actions", np.zeros((0, spec.size), np.float32))
        actions, still = self._actions(rows, count - 1).numpy(), message.get("still")
        if still is not None:
            row = still[None] if isinstance(still, np.ndarray) else still
            still = self._actions(row, 1, "still")[0]
        elif spec.kind != "absolute":
            still = torch.zeros(spec.size).clamp(torch.tensor(spec.low), torch.tensor(spec.high))
        elif count > 1:
            still = torch.from_numpy(actions[-1])
        else:
            raise RecipeError("actions are positions: give `still`, the action for no motion now")
        goal = self._picture("goal", message.get("goal"), self.card.frame_size)
        seed = _seed(message)
        return PlanRequest(planner, frames, actions, goal, still.numpy(), seed)

    def read_actions(self, message: Mapping[str, Any]) -> tuple[Tensor, ...]:
        """Check a client's further message; the actions `[stride, A]` of each latent frame.

        Raises:
            ShapeError, RecipeError: a value is missing or wrong.
        """
        if {*message} != {"actions"}:
            raise RecipeError(
                "send `frames` to start, and then `actions`; or `observed` for a plan"
            )
        rows, stride = message["actions"], self.stride
        count = len(rows) if isinstance(rows, np.ndarray) and rows.ndim == 2 else 0
        if not count or count % stride or count > CHUNK * stride:
            raise ShapeError(
                f"actions are [N, {self.card.action.size}], N from {stride} to {CHUNK * stride} in "
                f"steps of {stride}, not {_described(rows)}"
            )
        return torch.split(self._actions(rows, count), stride)

    def _actions(self, rows: Any, count: int, name: str = "actions") -> Tensor:
        wanted = (count, self.card.action.size)
        if not isinstance(rows, np.ndarray) or rows.shape != wanted or rows.dtype.kind not in "fiu":
            raise ShapeError(f"{name} are numbers {list(wanted)}, not {_described(rows)}")
        actions = torch.from_numpy(rows.astype(np.float32))
        return self._world.checked(actions[None])[0] if count else actions

    def _picture(self, name: str, picture: Any, shape: Sequence[int]) -> NDArray[np.uint8]:
        """The picture, or pictures `[K, …]`; of a single one the first axis may be left out."""
        wanted = (*shape, 3)
        right = {wanted, wanted[1:]} if wanted[0] == 1 else {wanted}
        fits = isinstance(picture, np.ndarray) and picture.dtype == "u1" and picture.shape in right
        if not fits:
            raise ShapeError(f"{name}: uint8 {list(wanted)}, not {_described(picture)}")
        return picture.reshape(wanted)

    def start(self, starts: Sequence[Start]) -> list[tuple[Running, Answer]]:
        """Begin videos; each answer shows the last given frame as the model sees it."""
        device = self._world.device
        video = torch.stack([as_clip(start.frames) for start in starts]).to(device)
        between = torch.from_numpy(np.stack([start.actions for start in starts])).to(device)
        seeds = [start.seed for start in starts]
        with noting("when the model begins", *self._world.children()):
            whole = self._world.stream(video, between, steps=self._steps, seeds=seeds)
            parts = self._parted(whole, len(starts))
        begun: list[tuple[Running, Answer]] = []
        for row, (start, stream) in enumerate(zip(starts, parts, strict=True)):
            states = None
            if "states" in start.want:
                own = video[row : row + 1], between[row : row + 1]
                states = self._world.stream_states(*own, seeds=[start.seed])
            shown = stream.given[0, -1:]
            goal = None if start.goal is None else self._goal(start.goal)
            running = Running(stream, states, goal, start.want)
            now = {} if states is None else {n: v[0][None] for n, v in states.current.items()}
            begun.append((running, self._answer(running, shown, now)))
        return begun

    def plan(self, requests: Sequence[PlanRequest]) -> list[Answer | AcwmError]:
        """Plan for clients, one after the other; `actions` `[N, A]` each."""
        answers: list[Answer | AcwmError] = []
        for request in requests:
            try:
                with noting("while the model plans", *self._world.children()):
                    actions = request.planner.plan(request, self._goal(request.goal))
                answers.append({"actions": actions})
            except Exception as error:  # of a component; other clients go on
                answers.append(AcwmError(sentence(error)))
        return answers

    def step(self, steps: Sequence[Step]) -> list[Answer | AcwmError]:
        """Move videos by one latent frame each, those that are alike in one forward pass."""
        answers: dict[int, Answer | AcwmError] = {}
        for places in self._alike([step.running.stream for step in steps]):
            try:
                moved = self._step_alike([steps[place] for place in places])
            except Exception as error:  # of a component; other groups go on
                moved = [AcwmError(sentence(error))] * len(places)
            answers |= zip(places, moved, strict=True)
        return [answers[place] for place in range(len(steps))]

    def _step_alike(self, steps: Sequence[Step]) -> list[Answer | AcwmError]:
        rows = torch.stack([step.actions[0] for step in steps]).to(self._world.device)
        videos = [step.running for step in steps]
        with noting("while the model predicts", *self._world.children()):
            frames, named = self._moved(videos, rows), self._moved_states(videos, rows)
        parts = zip(videos, frames, named, strict=True)
        return [self._checked_answer(*facts) for facts in parts]

    def _alike(self, streams: Sequence[Any]) -> list[list[int]]:
        """The places of streams that can move together."""
        groups: dict[Any, list[int]] = {}
        for place, stream in enumerate(streams):
            kind = self._joiner.kind(stream) if self.joins and len(streams) > 1 else place
            groups.setdefault(kind, []).append(place)
        return [*groups.values()]

    def _moved(self, videos: Sequence[Running], rows: Tensor) -> Video:
        """The next frames `[B, stride, 3, H, W]` of alike videos."""
        stream = self._together([video.stream for video in videos])
        frames = stream.step(rows)
        for video, part in zip(videos, self._parted(stream, len(videos)), strict=True):
            video.stream = part
        return frames

    def _moved_states(self, videos: Sequence[Running], rows: Tensor) -> list[dict[str, Tensor]]:
        """The fields of the state in the next frames, of those that want them."""
        named: list[dict[str, Tensor]] = [{} for _ in videos]
        asking = [(k, video.states) for k, video in enumerate(videos) if video.states is not None]
        for places in self._alike([states for _, states in asking]):
            numbers = [asking[place][0] for place in places]
            stream = self._together([asking[place][1] for place in places])
            fields = stream.step(rows[numbers])
            parts = self._parted(stream, len(numbers))
            for row, (number, part) in enumerate(zip(numbers, parts, strict=True)):
                videos[number].states = part
                named[number] = {name: values[row] for name, values in fields.items()}
        return named

    def _together(self, streams: Sequence[Any]) -> Any:
        return streams[0] if len(streams) == 1 else self._joiner.joined(streams)

    def _parted(self, stream: Any, clips: int) -> list[Any]:
        return [stream] if clips == 1 else self._joiner.parted(stream, clips)

    def _checked_answer(
        self, running: Running, video: Tensor, states: Mapping[str, Tensor]
    ) -> Answer | AcwmError:
        if not video.isfinite().all():
            return ShapeError("the model's prediction is not finite: start again, or train it anew")
        return self._answer(running, video, states)

    def _answer(self, running: Running, video: Tensor, states: Mapping[str, Tensor]) -> Answer:
        """What a client receives of frames `[N, 3, H, W]`."""
        pixels = to_pixels(video)
        answer: Answer = {"frames": pixels}
        if "states" in running.want:
            answer["states"] = {name: values.cpu().numpy() for name, values in states.items()}
        if "keypoints" in running.want:
            whole = video if running.last is None else torch.cat([running.last, video])
            seen = self._world.read_keypoints(whole[None])
            answer["keypoints"] = seen.values[0, -1].cpu().numpy()
            running.last = video[-1:].clone()  # a view would keep the frames of all clients
        if running.goal is not None:
            answer |= self._distances(pixels, running.goal)
        return answer

    def _distances(self, pixels: NDArray[np.uint8], goal: Goal) -> Answer:
        assert self._task is not None
        assert self._estimator is not None
        seen = self._estimator.read(as_clip(pixels))
        own = Observation(seen.masks, seen.states)
        return {name: judged(self._task, name, own, goal) for name in ("distance", "success")}

    def _goal(self, picture: NDArray[np.uint8]) -> Goal:
        assert self._estimator is not None
        seen = self._estimator.read(as_clip(picture[None]))
        return Goal({n: values[0] for n, values in seen.states.items()}, seen.masks[0], picture)

    def _tries_joining(self) -> bool:
        """Whether joined streams predict what separate ones do, tried on random frames.

        Raises:
            RecipeError: the model cannot be streamed at all.
        """
        device, rng = self._world.device, torch.Generator().manual_seed(0)
        size = (TRIAL, self.given, 3, *self.card.frame_size)
        video = torch.rand(size, generator=rng).to(device)
        low, high = self._world.action_low, self._world.action_high
        spread = torch.rand(TRIAL, self.given - 1, len(low), generator=rng).to(device)
        between = low + spread * (high - low)

        def fresh(row: int) -> Stream:
            own = video[row : row + 1], between[row : row + 1]
            return self._world.stream(*own, steps=self._steps, seeds=[row])

        alone, parts = ([fresh(row) for row in range(TRIAL)] for _ in range(2))
        try:
            return all(self._agree(alone, parts, rows) for rows in self._random_rows(rng))
        except Exception:
            return False  # whatever a stream of a plugin holds: it is then served by itself

    def _random_rows(self, rng: torch.Generator) -> Iterator[Tensor]:
        low, high = self._world.action_low, self._world.action_high
        for _ in range(TRIAL):
            spread = torch.rand(TRIAL, self.stride, len(low), generator=rng).to(low)
            yield low + spread * (high - low)

    def _agree(self, alone: list[Stream], parts: list[Stream], rows: Tensor) -> bool:
        if len({self._joiner.kind(part) for part in parts}) > 1:
            return False
        wanted = torch.cat([stream.step(rows[k : k + 1]) for k, stream in enumerate(alone)])
        whole = self._joiner.joined(parts)
        frames = whole.step(rows)
        parts[:] = self._joiner.parted(whole, TRIAL)
        return bool((frames - wanted).abs().mean() <= CLOSE)


def _check_names(message: Mapping[str, Any], what: str, known: Collection[str]) -> None:
    for name in message:
        if name not in known:
            raise RecipeError(f"{what} has no {name!r}{suggest(str(name), known)}")


def _seed(message: Mapping[str, Any]) -> int:
    seed = message.get("seed", 0)
    if type(seed) is not int or not 0 <= seed < 2**63:
        raise RecipeError("seed is a whole number from 0 to 2^63 - 1")
    return seed


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    return "missing" if value is None else type(value).__name__
