"""`Recordings`: recorded states and actions, for learners that imitate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal, Task
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.evaluation.score import estimator_for
from acwm_planning.policies.saved import PolicyInputs, small_pictures
from acwm_policy.judging import needs_of

PICTURES = ["pictures"]
"""What `PolicySettings.observe` is for pictures in place of states."""

HELD_OUT = 10
"""Every tenth training episode is held out to measure errors, if there is no test split."""

MOST_PICTURES = 2000
"""Approximate number of moments with pictures on which an error is measured."""


class Recorded(NamedTuple):
    """An episode of T frames.

    Attributes:
        states: what is observed of the state, `[T, S]`, or of the pictures; see `PolicyInputs`.
        goals: the goal that each frame would be, `[T, G]`.
        actions: scaled to [-1, 1], `[T, A]`; row t leads from frame t to t + 1.
    """

    states: Tensor
    goals: Tensor
    actions: Tensor


class Decisions(NamedTuple):
    """What was done in N moments: observations `[N, O]` and scaled actions `[N, chunk · A]`."""

    vectors: Tensor
    actions: Tensor


class Recordings:
    """Recorded episodes to imitate.

    The goal of an episode is not recorded, so any later state of it is taken as its goal
    (hindsight; Ghosh et al. 2021, arXiv 1912.06088).

    Args:
        episodes: to learn from.
        held_out: to measure errors on.
        inputs: what a policy observes.
        hold: number of frames for which an action of the policy is held.
        chunk: number of actions that it decides on at once.

    Attributes:
        observed: number O of values that a policy observes.
        action_size: number of values that it decides on, `chunk` · A.
        shortest: fewest steps of a stage.
    """

    shortest = 10_000

    def __init__(
        self,
        episodes: Sequence[Recorded],
        held_out: Sequence[Recorded],
        inputs: PolicyInputs,
        hold: int,
        chunk: int = 1,
    ) -> None:
        span = hold * chunk
        learnt, tested = (_Frames(part, span) for part in (episodes, held_out))
        self._inputs, self._hold, self._chunk = inputs, hold, chunk
        if not len(learnt):
            raise DataError(f"no recording has more than the {span} frames of a decision")
        self._learnt = learnt
        self.observed, self.action_size = inputs.size, chunk * learnt.actions.shape[1]
        tested = tested if len(tested) else learnt
        apart = max(hold, len(tested) // MOST_PICTURES) if inputs.picture else hold
        every = torch.arange(0, len(tested), apart)
        self._tested = self._decisions(tested, every, torch.Generator().manual_seed(0))
        away = self._tested.actions - learnt.actions.mean(0).float().repeat(chunk)
        self._spread = float(away.square().mean())
        if not self._spread > 0:
            raise DataError("the recorded actions are all alike, so they teach nothing")
        self._error: float | None = None

    def draw(self, number: int, random: torch.Generator) -> Decisions:
        """A number of moments, drawn uniformly from all frames."""
        places = torch.randint(len(self._learnt), (number,), generator=random)
        return self._decisions(self._learnt, places, random)

    def _decisions(self, frames: _Frames, rows: Tensor, random: torch.Generator) -> Decisions:
        """What was done in some of the frames `[N]`, each with a later one as the goal."""
        span, (first, now, last) = self._hold * self._chunk, frames.places(rows)
        share = torch.rand(len(now), generator=random)
        later = (now + span + (share * (last - now - span + 1)).long()).clamp(max=last)
        before = frames.states[torch.maximum(now - self._hold, first)]
        vectors = self._inputs.vectors(frames.states[now], before, frames.goals[later])
        passed = frames.actions[now[:, None] + torch.arange(span)]  # [N, span, A]
        held = passed.unflatten(1, (self._chunk, self._hold)).mean(2)
        return Decisions(vectors, held.flatten(1).float())

    @torch.no_grad()
    def score(self, network: nn.Module) -> dict[str, float]:
        """The error of a policy on held-out moments; 1 is that of always taking the mean action."""
        error = (network(self._tested.vectors) - self._tested.actions).square().mean()
        self._error = float(error) / self._spread
        return {"error": self._error}

    def note(self) -> str:
        """The last error."""
        return "" if self._error is None else f"error {self._error:.2f}"

    def state(self) -> dict[str, Any]:
        """Nothing: recordings stay as they are."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on as when `state` was called."""

    def close(self) -> None:
        """Free all resources."""


class _Frames:
    """The frames of episodes one after the other, of which those with enough after them count."""

    def __init__(self, episodes: Sequence[Recorded], span: int) -> None:
        long = [episode for episode in episodes if len(episode.states) > span]
        lengths = torch.tensor([len(episode.states) for episode in long], dtype=torch.int64)
        self._ends, self._counted = lengths.cumsum(0), (lengths - span).cumsum(0)
        self._begun, self._span = self._ends - lengths, span
        states, goals, actions = zip(*(long or [Recorded(*[torch.zeros(0, 0)] * 3)]), strict=True)
        same = all(one is other for one, other in zip(states, goals, strict=True))
        self.states, self.actions = torch.cat(states), torch.cat(actions)
        self.goals = self.states if same else torch.cat(goals)  # pictures are large

    def __len__(self) -> int:
        return int(self._counted[-1]) if len(self._counted) else 0

    def places(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of frames that count: the first frame of their episodes, they, and the last one."""
        owners = torch.searchsorted(self._counted, numbers, right=True)
        return self._begun[owners], numbers + owners * self._span, self._ends[owners] - 1


def read_recordings(
    folder: EpisodeDataset,
    held_out: EpisodeDataset | None,
    task: Task | None,
    observe: Sequence[str] | None,
    hold: int,
    chunk: int,
    picture: int = 48,
) -> tuple[Recordings, PolicyInputs]:
    """The recordings of a dataset, and what a policy observes of them.

    Args:
        folder: the episodes to learn from.
        held_out: those to measure errors on; every tenth of the others if None.
        task: says what a goal is; None for a policy without goals.
        observe: fields of the state to observe, or `PICTURES`, which are all that is observed of
            data without states; see `PolicySettings`.
        hold: see `Recordings`.
        chunk: see `Recordings`.
        picture: longer side of the pictures, in pixels; smaller frames stay as they are.

    Raises:
        DataError: there are too few episodes, or a field is missing.
        RecipeError: the task looks at what was not recorded.
    """
    card = folder.card.environment
    shapes = {field.name: [*field.shape] for field in card.state}
    seen, aims, needed = None, dict[str, list[int]](), list[str]()
    if (observe == PICTURES and "pictures" not in shapes) or not (shapes or observe):
        share = min(1.0, picture / max(card.frame_size))
        size = [max(1, round(side * share)) for side in card.frame_size]
        seen = PolicyInputs({}, {}, [], [], [], size, task is not None)
    else:
        aims, needed = _goal_of(folder, task, shapes)
    state = {n: shapes[n] for n in ([] if seen else _observed(card, shapes, needed, observe))}
    chosen = [range(len(folder)), range(0)]
    if held_out is None:
        cut = [number for number in range(len(folder)) if number % HELD_OUT == HELD_OUT - 1]
        chosen = [[n for n in range(len(folder)) if n not in {*cut}], cut]
    sets = [[_recorded(folder, n, seen, state, aims) for n in numbers] for numbers in chosen]
    if held_out is not None:
        sets[1] = [_recorded(held_out, n, seen, state, aims) for n in range(len(held_out))]
    inputs = (
        _scaled(sets[0], state, aims, hold)
        if seen is None
        else _scaled_pictures(sets[0], seen, hold)
    )
    return Recordings(sets[0], sets[1], inputs, hold, chunk), inputs


def _goal_of(
    folder: EpisodeDataset, task: Task | None, shapes: Mapping[str, list[int]]
) -> tuple[dict[str, list[int]], list[str]]:
    """The fields of a goal, with their shapes, and those of the state that the task looks at."""
    if task is None:
        return {}, []
    fields = folder[0].states
    nothing = np.zeros((1, 1), np.uint8)
    end = Goal({name: values[-1] for name, values in fields.items()}, nothing, nothing)
    needs = needs_of(task, {name: fields[name] for name in shapes if name in fields}, end)
    return {name: shapes[name] for name in needs.goal}, needs.state


def _observed(
    card: EnvironmentCard,
    shapes: Mapping[str, list[int]],
    needed: Sequence[str],
    observe: Sequence[str] | None,
) -> list[str]:
    """The fields to observe, in the card's order."""
    for name in observe or ():
        if name not in shapes:
            raise RecipeError(
                f"observe={name}: it was not recorded{suggest(name, shapes)}; give some of "
                f"{', '.join(shapes)}"
            )
    estimator = estimator_for(card) if observe is None else None
    readable = shapes if estimator is None else [*estimator.fields, *needed]
    return [name for name in shapes if name in (observe or readable)]


def _recorded(
    folder: EpisodeDataset,
    number: int,
    seen: PolicyInputs | None,
    state: Mapping[str, list[int]],
    aims: Mapping[str, list[int]],
) -> Recorded:
    """An episode: its pictures if these are `seen`, else some fields of the state and the goal."""
    action = folder.card.environment.action
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (action.low, action.high))
    actions = torch.from_numpy(np.array(folder.actions(number))).double()
    scaled = (2 * (actions - low) / (high - low) - 1).clamp(-1, 1)
    if seen:
        rows = small_pictures(torch.from_numpy(folder.video(number)), seen.picture)
        return Recorded(rows, rows if seen.aims else rows[:, :0], scaled)
    parts = [folder.states(number, [*names]) for names in (state, aims) if names]
    values = [torch.from_numpy(part).double() for part in parts]
    goals = values[1] if aims else values[0][:, :0]
    return Recorded(values[0], goals, scaled)


def _scaled_pictures(episodes: Sequence[Recorded], seen: PolicyInputs, hold: int) -> PolicyInputs:
    """Pictures with their mean and spread in the recordings, of a few thousand frames."""
    apart = max(1, sum(len(episode.states) for episode in episodes) // MOST_PICTURES)
    whole = torch.cat([episode.states[::apart].float() for episode in episodes])
    moved = [(e.states[hold::apart].float() - e.states[:-hold:apart]).flatten() for e in episodes]
    mean = whole.mean(0)
    spreads = [(whole - mean).square().mean().sqrt(), torch.cat(moved).square().mean().sqrt()]
    std, change = ([max(float(spread), 1e-3)] for spread in spreads)
    rounded = [round(value, 1) for value in mean.tolist()]
    return replace(seen, mean=rounded, std=std, change=change)


def _scaled(
    episodes: Sequence[Recorded],
    state: Mapping[str, list[int]],
    aims: Mapping[str, list[int]],
    hold: int,
) -> PolicyInputs:
    """What is observed, with its mean and spread in the recordings."""
    whole = torch.cat([torch.cat([episode.states, episode.goals], 1) for episode in episodes])
    moved = torch.cat([episode.states[hold:] - episode.states[:-hold] for episode in episodes])
    known = [values[values.isfinite().all(1)] for values in (whole, moved)]
    if min(map(len, known)) < 2:
        raise DataError("fewer than two frames have recorded states that are finite")
    spreads = [values.std(0, correction=0) for values in known]
    std, change = (torch.where(spread > 1e-9, spread, 1.0).tolist() for spread in spreads)
    return PolicyInputs(dict(state), dict(aims), known[0].mean(0).tolist(), std, change)
