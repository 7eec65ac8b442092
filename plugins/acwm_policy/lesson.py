"""What a policy learns from: a task, starts, scenes, and the scale of what it observes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import Goal, SolvedAtStartError, Task
from acwm_core.errors import AcwmWarning, DataError, RecipeError, suggest
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import progress_bar
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.training.run import RunBundle
from acwm_dream.starts import DatasetStarts, DreamStart, SimulatorStarts
from acwm_planning.episode import load_task
from acwm_planning.policies.saved import PolicyInputs, side_by_side
from acwm_planning.rewards.task import RewardTask
from acwm_policy.episodes import Episodes
from acwm_policy.judging import judge, needs_of
from acwm_policy.recordings import PICTURES, Recordings, read_recordings
from acwm_policy.scenes import DreamScenes, Scenes, SimulatorScenes, States

Place = Literal["dream", "simulator", "recordings"]
"""What a policy learns from: acting in a model or in the simulator, or recorded actions."""

MEASURED = 256
"""Fewest random steps from which the scale of observations is measured."""


class Measured(NamedTuple):
    """What a policy observes, and the scale of it all.

    Attributes:
        inputs: what it observes.
        unit: mean distance of the starts, which is worth a reward of 1.
    """

    inputs: PolicyInputs
    unit: float


@dataclass(frozen=True)
class Lesson:
    """What a policy learns from.

    Attributes:
        card: card of the environment.
        task: name of the task; empty for a policy without one.
        repeat: number of actions for which each action of the policy is held.
        place: what it learns from.
        measured: what is observed, and its scale.
        source: episodes to act in, or recordings.
    """

    card: EnvironmentCard
    task: str
    repeat: int
    place: Place
    measured: Measured
    source: Episodes | Recordings

    @property
    def episodes(self) -> Episodes:
        """Episodes to act in, side by side; there are none if `place` is "recordings"."""
        assert isinstance(self.source, Episodes)
        return self.source

    @property
    def recordings(self) -> Recordings:
        """Recordings to imitate, if `place` is "recordings"."""
        assert isinstance(self.source, Recordings)
        return self.source


class Beginnings(NamedTuple):
    """Starts, and the specs of their episodes in the simulator, if they are of it."""

    starts: list[DreamStart]
    specs: list[EpisodeSpec]


def find_task(name: str, card: EnvironmentCard) -> Task:
    """The task ``ENVIRONMENT.TASK`` or ``TASK`` of a model's environment.

    Raises:
        RecipeError: it is a task of another environment, or there is no such task.
    """
    environment, _, task = name.rpartition(".")
    if environment and environment != card.name:
        raise RecipeError(f"{name} is a task of {environment}, not of {card.name}")
    return load_task(card.name, task)


def find_reward(name: str, folder: Path, bundle: RunBundle) -> RewardTask:
    """The task of maximising a reward in the environment of this name.

    Raises:
        DataError: there is no such reward.
        RecipeError: the model is of another environment, or the reward cannot judge its states.
    """
    if name != bundle.card.name:
        raise RecipeError(f"the model is of {bundle.card.name}, not of {name}")
    return RewardTask.read(folder, bundle.card)


def begin_episodes(
    card: EnvironmentCard, given: int, task: Task, count: int, progress: bool = False
) -> Beginnings:
    """The starts of the first training episodes, as the simulator shows them, with goals.

    Args:
        card: card of the environment, with the frame size.
        given: number of context frames.
        task: draws the goals.
        count: number of starts; episodes that are solved at their start are passed over.
        progress: show a progress bar, as some goals take seconds to simulate.
    """
    beginnings, number = Beginnings([], []), 0
    shown = progress_bar(f"starts of {card.name}", count, unit="starts", shown=progress)
    with closing(SimulatorStarts(card, given, task)) as simulator, shown as report:
        rng = np.random.default_rng(0)  # unused, as the episode is given
        while len(beginnings.starts) < count:
            spec = EpisodeSpec(card.name, "train", number, options={"size": card.frame_size})
            number += 1
            try:
                beginnings.starts.append(simulator.draw(rng, {"spec": spec}))
            except SolvedAtStartError:
                if number > 10 * count:
                    raise
                continue
            beginnings.specs.append(spec)
            report(1)
    return beginnings


def recorded_starts(folder: str | Path, given: int, count: int) -> Beginnings:
    """The first frames of the first training episodes of a dataset; goals are their last frames."""
    episodes = EpisodeDataset(Path(folder), "train")
    starts, rng = DatasetStarts(episodes, given), np.random.default_rng(0)
    numbers = range(min(count, len(episodes)))
    return Beginnings([starts.draw(rng, {"episode": number}) for number in numbers], [])


def beginnings(
    bundle: RunBundle,
    task: Task,
    count: int,
    data: str | Path | None,
    place: Place,
    progress: bool = False,
) -> Beginnings:
    """The starts of training: the simulator's, or those of a dataset.

    Raises:
        DataError: there is neither.
    """
    card, given = bundle.card, bundle.world_model.context_frames
    simulated = card.name in catalog().registry("environment")
    if data is not None and place == "simulator":
        raise RecipeError("--data is for the dream: the simulator begins with its own episodes")
    if data is None and simulated:
        return begin_episodes(card, given, task, count, progress)
    if data is None:
        text = f"{card.name} has no simulator here: episodes begin like those of its data"
        warnings.warn(text, AcwmWarning, stacklevel=2)
    folder = data or bundle.recipe.data.get("path")
    if folder is None:
        raise DataError("there is no dataset to start from: name one with --data")
    return recorded_starts(folder, given, count)


def prepare(
    bundle: RunBundle,
    task: Task,
    begun: Beginnings,
    place: Place,
    number: int,
    observe: Sequence[str] | None = None,
    bonus: float = 1.0,
    seed: int = 0,
    measured: Measured | None = None,
) -> Lesson:
    """The scenes of a task, and what a policy observes in them.

    Args:
        bundle: the loaded run.
        task: the task.
        begun: the starts.
        place: in the dream of the model, or in the simulator.
        number: number of scenes.
        observe: names of the fields of the state to observe; see `PolicySettings`.
        bonus: reward for success.
        seed: of the starts that are drawn, and of the random steps that measure the scale of
            observations.
        measured: what these steps have measured before; None to measure.
    """
    card, world = bundle.card, bundle.world_model
    shapes = {name: [*shape] for name, shape in world.state_shapes.items()}
    goals = [start.goal for start in begun.starts if start.goal is not None]
    if place == "dream":
        scenes: Scenes = DreamScenes(world, begun.starts, number)
    else:
        repeat = world.codec.temporal_stride
        scenes = SimulatorScenes(card, begun.specs, goals, repeat, number)
    if not shapes:
        raise RecipeError(f"{type(world.model).__name__} learns no states, so none can be observed")
    first, _ = scenes.begin([0], [0])
    needs = needs_of(task, {name: first[name] for name in shapes}, goals[0])
    chosen = measured.inputs.state if measured else chosen_fields(world, card, needs.state, observe)
    scenes.only({*chosen, *needs.state})
    if measured is None:
        state = {name: shapes[name] for name in chosen}
        aims = {name: [*np.shape(goals[0].state[name])] for name in needs.goal}
        inputs = measure(scenes, card, task, state, aims, goals, seed)
        measured = Measured(inputs, usual_distance(scenes, task, goals))
    inputs, unit = measured
    options = {"unit": unit, "bonus": bonus, "watched": needs.state, "seed": seed}
    episodes = Episodes(scenes, task, card, inputs, **options)
    return Lesson(card, task.name, scenes.repeat, place, measured, episodes)


def imitate(
    folder: str | Path,
    name: str,
    observe: Sequence[str] | None,
    hold: int,
    chunk: int,
    picture: int = 48,
) -> Lesson:
    """Recordings to imitate.

    Args:
        folder: a dataset.
        name: ``ENVIRONMENT.TASK``, or ``ENVIRONMENT`` for a policy without goals.
        observe: names of the fields of the state to observe; see `PolicySettings`.
        hold: number of frames for which an action is held.
        chunk: number of actions that are decided on at once.
        picture: longer side of pictures that are observed, in pixels.

    Raises:
        RecipeError: the dataset is of another environment.
        DataError: it has too few episodes.
    """
    train = EpisodeDataset(Path(folder), "train")
    card = train.card.environment
    if "." not in name and name != card.name:
        raise RecipeError(
            f"{folder} holds recordings of {card.name}: write {card.name} in place of {name}"
        )
    task = None if name == card.name else find_task(name, card)
    tested = EpisodeDataset(Path(folder), "ind_test") if train.card.splits.get("ind_test") else None
    recordings, inputs = read_recordings(train, tested, task, observe, hold, chunk, picture)
    named = "" if task is None else task.name
    return Lesson(card, named, hold, "recordings", Measured(inputs, 1.0), recordings)


def chosen_fields(
    world: WorldModel, card: EnvironmentCard, needed: Sequence[str], observe: Sequence[str] | None
) -> list[str]:
    """The fields to observe, in the model's order.

    By default those that an estimator reads too, so that the policy can act from pictures, and
    those that the task looks at; all that the model predicts if there is no estimator.
    """
    predicted = [*world.state_shapes]
    if observe == PICTURES and "pictures" not in predicted:
        raise RecipeError("observe=pictures is for algorithm=clone: a dream of states has none")
    for name in observe or ():
        if name not in predicted:
            known = ", ".join(predicted)
            raise RecipeError(
                f"observe={name}: the model does not predict it{suggest(name, predicted)}; it "
                f"predicts {known}"
            )
    if observe is not None:
        return [name for name in predicted if name in observe]
    estimator = estimator_for(card)
    readable = predicted if estimator is None else [*estimator.fields, *needed]
    return [name for name in predicted if name in readable]


def measure(
    scenes: Scenes,
    card: EnvironmentCard,
    task: Task,
    state: Mapping[str, list[int]],
    aims: Mapping[str, list[int]],
    goals: Sequence[Goal],
    seed: int,
) -> PolicyInputs:
    """What a policy observes, with the scale of it under random actions."""
    rng, low, high = np.random.default_rng(seed), card.action.low, card.action.high
    length = -(-task.max_steps // scenes.repeat)
    states, changes = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for _ in range(max(1, MEASURED // (scenes.number * length))):
        begun = rng.integers(scenes.starts, size=scenes.number).tolist()
        now = side_by_side(scenes.begin(range(scenes.number), begun)[0], state).numpy()
        for _ in range(length):
            shape = scenes.number, card.action.size
            actions = rng.uniform(low, high, shape).astype(np.float32).clip(low, high)
            later = side_by_side(_last(scenes.step(actions)), state).numpy()
            states.append(later)
            changes.append(later - now)
            now = later
    mean, std = _scale(np.concatenate(states))
    _, change = _scale(np.concatenate(changes))
    of_state, place = dict[str, slice](), 0
    for name, shape in state.items():
        of_state[name] = slice(place, place := place + math.prod(shape))
    for name, shape in aims.items():
        if name in of_state and state[name] == shape:  # alike are scaled alike
            more = mean[of_state[name]], std[of_state[name]]
        else:
            values = np.stack([goal.state[name] for goal in goals])
            more = _scale(values.reshape(len(goals), -1).astype(np.float64))
        mean, std = np.concatenate([mean, more[0]]), np.concatenate([std, more[1]])
    return PolicyInputs(dict(state), dict(aims), mean.tolist(), std.tolist(), change.tolist())


def usual_distance(scenes: Scenes, task: Task, goals: Sequence[Goal]) -> float:
    """The mean distance of the starts from their goals."""
    distances = list[float]()
    for first in range(0, len(goals), scenes.number):
        which = range(min(scenes.number, len(goals) - first))
        states, aims = scenes.begin(which, [first + row for row in which])
        one = {name: np.asarray(values)[:, None] for name, values in states.items()}
        count = len(which)
        unknown, once = np.full(count, np.nan), np.ones(count, np.int64)
        judged = judge(task, one, aims, unknown, np.zeros(count, np.bool_), once)
        distances += judged.distance[np.isfinite(judged.distance)].tolist()
    if not distances or not np.mean(distances) > 0:
        raise RecipeError(
            f"the model predicts no state from which the task {task.name!r} could compute a "
            "distance at the start, so no policy can be trained in it"
        )
    return float(np.mean(distances))


def _scale(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation `[S]` of what is known of `[N, S]`; 0 and 1 where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        known = np.where(np.isfinite(values), values, np.nan)
        mean, std = np.nanmean(known, 0), np.nanstd(known, 0)
    return np.nan_to_num(mean), np.where(np.isfinite(std) & (std > 1e-9), std, 1.0)


def _last(states: States) -> dict[str, Any]:
    return {name: values[:, -1] for name, values in states.items()}
