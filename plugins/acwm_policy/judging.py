"""What a task looks at, and how it judges the steps of scenes by their states alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.task import Goal, Task, judged
from acwm_core.errors import RecipeError
from acwm_planning.predicted import NotPredicted, observation_of
from acwm_policy.scenes import States

DIFFERENCE = 1e-3
"""By how much values are changed to see how a task's distance changes, in their units."""


class Watched(Mapping[str, Any]):
    """Fields that remember which of them were asked for (`asked`)."""

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._fields, self.asked = fields, dict[str, None]()

    def __getitem__(self, name: str) -> Any:
        value = self._fields[name]
        self.asked[name] = None
        return value

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)


class Needs(NamedTuple):
    """What a task looks at."""

    state: list[str]
    goal: list[str]


def needs_of(task: Task, states: States, goal: Goal) -> Needs:
    """The fields of the state and of the goal that a task looks at, to judge a scene.

    Args:
        task: the task.
        states: of one scene, `[T, …]`.
        goal: its goal.

    Raises:
        RecipeError: the task looks at something that is not in the states.
    """
    frames = len(next(iter(states.values())))
    seen, aim = Watched(states), Watched(goal.state)
    watched = Goal(aim, goal.mask, goal.frame)
    try:
        for method in ("distance", "success", "failed"):
            judged(task, method, observation_of(seen, frames), watched)
    except (NotPredicted, KeyError) as error:
        raise RecipeError(
            f"of the state, {', '.join(states)} are known, and the task {task.name!r} looks at "
            f"more than that, so no policy can be trained for it ({str(error).strip(chr(39))})"
        ) from error
    return Needs([*seen.asked], [*aim.asked])


class Judgement(NamedTuple):
    """How a step of n scenes went."""

    distance: NDArray[np.float64]  # `[n]`, in the last frame that counts; the one before if unknown
    success: NDArray[np.bool_]
    failed: NDArray[np.bool_]  # in this step or before
    frame: NDArray[np.int64]  # `[n]`, the frame of the step that has the distance; -1 if none has


def judge(
    task: Task,
    states: States,
    goals: Sequence[Goal],
    before: NDArray[np.float64],
    failed: NDArray[np.bool_],
    frames: NDArray[np.int64],
) -> Judgement:
    """Judge the video frames of a step, each scene by the task and its own goal.

    Args:
        task: the task.
        states: of n scenes in the frames of the step, `[n, T, …]`.
        goals: of the scenes.
        before: their distances before the step, `[n]`.
        failed: which have failed before the step, `[n]`.
        frames: for each scene, how many of the frames lie within the task's time, at least 1.
    """
    distance, success, after = before.copy(), np.zeros(len(goals), np.bool_), failed.copy()
    frame = np.full(len(goals), -1)
    for row, goal in enumerate(goals):
        count = int(frames[row])
        seen = observation_of({name: v[row, :count] for name, v in states.items()}, count)
        distances, solved, failures = (
            judged(task, method, seen, goal) for method in ("distance", "success", "failed")
        )
        after[row] = failed[row] or bool(failures.any())
        success[row] = bool(solved.any()) and not failed[row]
        last = int(solved.argmax()) + 1 if success[row] else count
        known = np.flatnonzero(np.isfinite(distances[:last]))
        if len(known):
            frame[row] = known[-1]
            distance[row] = distances[known[-1]]
    return Judgement(distance, success, after, frame)


def slopes(
    task: Task, states: States, goals: Sequence[Goal], names: Sequence[str]
) -> dict[str, NDArray[np.float64]]:
    """How the task's distance changes with the values of a scene, `[n, …]` for each field.

    A task's distance is a program of NumPy, which knows no gradients. These are central differences
    with steps of `DIFFERENCE` units. They are 0 where a distance is unknown or jumps.

    Args:
        task: the task.
        states: of n scenes, `[n, …]`.
        goals: of the scenes.
        names: the fields; see `needs_of`.
    """
    fields = {name: np.asarray(states[name], np.float64) for name in names}
    slopes = {name: np.zeros(values.shape) for name, values in fields.items()}
    for row, goal in enumerate(goals):
        sizes = {name: values[row].size for name, values in fields.items()}
        count, place, tried = 2 * sum(sizes.values()), 0, dict[str, NDArray[Any]]()
        for name, size in sizes.items():
            values = np.repeat(fields[name][row].reshape(1, -1), count, 0)
            values[range(place, place + size), range(size)] += DIFFERENCE
            values[range(count // 2 + place, count // 2 + place + size), range(size)] -= DIFFERENCE
            tried[name], place = values.reshape(count, *fields[name].shape[1:]), place + size
        distances = judged(task, "distance", observation_of(tried, count), goal)
        slope = (distances[: count // 2] - distances[count // 2 :]) / (2 * DIFFERENCE)
        parts = np.split(np.nan_to_num(slope, posinf=0.0, neginf=0.0), np.cumsum([*sizes.values()]))
        for name, part in zip(sizes, parts, strict=False):
            slopes[name][row] = part.reshape(slopes[name].shape[1:])
    return slopes
