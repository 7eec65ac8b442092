"""`Episodes`: scenes with a task, side by side; one that ends begins again."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal, Task
from acwm_planning.policies.saved import PolicyInputs, raw_actions, side_by_side
from acwm_policy.judging import judge, slopes
from acwm_policy.scenes import Scenes, States

RECENT = 100
"""Number of ended episodes of which success and return are kept."""


class Step(NamedTuple):
    """What a step of n scenes leads to.

    Attributes:
        vectors: what a policy observes, `[n, O]`; of scenes that have ended, their new beginning.
        last: the same before they began again.
        rewards: `[n]`; differentiable with respect to actions in a dream.
        solved: which have ended by success, `[n]`.
        late: which have ended because their time is over, `[n]`; they would go on.
        failed: which have failed, so that nothing counts as success any more, `[n]`.
        frames: number of actions of each episode so far, `[n]`.
        returns: sum of the rewards of each episode so far, `[n]`.
    """

    vectors: Tensor
    last: Tensor
    rewards: Tensor
    solved: Tensor
    late: Tensor
    failed: Tensor
    frames: Tensor
    returns: Tensor

    @property
    def over(self) -> Tensor:
        """Which scenes have ended, `[n]`."""
        return self.solved | self.late


class Episodes:
    """Parallel episodes of a task; one that ends begins again at another start.

    The reward of a step is by how much the task's distance decreases, in units of `unit`, and a
    bonus for success, which ends the episode. A failure does not end it, but nothing after it
    counts as success. An episode ends late after the task's number of actions. Actions are scaled
    to [-1, 1].

    Args:
        scenes: the scenes.
        task: the task.
        card: card of the environment.
        inputs: what is observed.
        unit: the distance that is worth a reward of 1.
        bonus: the reward for success.
        watched: the fields that the task's distance depends on, for gradients; see `needs_of`.
        seed: of the starts that are drawn.

    Attributes:
        number: number n of scenes.
        observed: number O of values that a policy observes.
        action_size: number A of values of an action.
        recent: success and return of the last episodes that have ended.
        shortest: fewest steps after which it is worth while to begin all scenes anew.
    """

    def __init__(
        self,
        scenes: Scenes,
        task: Task,
        card: EnvironmentCard,
        inputs: PolicyInputs,
        *,
        unit: float,
        bonus: float = 1.0,
        watched: Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        self._scenes, self._task, self._inputs, self._watched = scenes, task, inputs, watched
        self._unit, self._bonus, self._random = unit, bonus, np.random.default_rng(seed)
        self._low, self._high = card.action.low, card.action.high
        self.number, self.observed, self.action_size = scenes.number, inputs.size, card.action.size
        self.shortest = 4 * scenes.number * -(-task.max_steps // scenes.repeat)
        self.recent = deque[tuple[bool, float]](maxlen=RECENT)
        self._goals: list[Goal] = []
        self._aims = self._now = torch.zeros(self.number, 0, dtype=torch.float64)
        self._distance = torch.zeros(self.number, dtype=torch.float64)
        self._returns = np.zeros(self.number)
        self._frames = np.zeros(self.number, np.int64)
        self._failed = np.zeros(self.number, np.bool_)

    def begin(self, starts: Sequence[int] | None = None) -> Tensor:
        """Begin all scenes, at these starts `[n]` or at random; what is observed, `[n, O]`."""
        chosen = self._drawn(self.number) if starts is None else starts
        states, self._goals = self._scenes.begin(range(self.number), chosen)
        self._aims = self._fields_of(self._goals)
        self._now = side_by_side(states, self._inputs.state)
        self._distance = torch.zeros_like(self._distance)
        self._fresh(np.arange(self.number), states)
        return self._inputs.vectors(self._now, self._now, self._aims)

    @property
    def distances(self) -> NDArray[np.float64]:
        """The distance of each scene from its goal, `[n]`; the last one that was known."""
        return self._distance.detach().numpy().copy()

    def step(self, actions: Tensor) -> Step:
        """Move all scenes by scaled actions `[n, A]`; those that end begin again.

        In a dream, observations and rewards are differentiable with respect to the actions, but for
        the bonus; see `acwm_policy.judging.slopes`.
        """
        states = self._scenes.move(raw_actions(actions, self._low, self._high))
        shown = {name: values.detach().numpy() for name, values in states.items()}
        counted = np.minimum(self._scenes.repeat, self._task.max_steps - self._frames)
        before = self._distance.detach().numpy()
        judged = judge(self._task, shown, self._goals, before, self._failed, counted)
        solved = judged.success & ~self._failed
        distance = torch.from_numpy(judged.distance)
        if actions.requires_grad:
            distance = distance + self._followed(states, shown, judged.frame)
        rewards = (self._distance - distance) / self._unit
        rewards = rewards + self._bonus * torch.from_numpy(solved)
        self._distance, self._failed = distance, judged.failed
        self._frames = self._frames + counted
        self._returns = self._returns + rewards.detach().numpy()
        late = (self._frames >= self._task.max_steps) & ~solved
        was, last = self._now, {name: values[:, -1] for name, values in states.items()}
        self._now = side_by_side(last, self._inputs.state)
        vectors = self._inputs.vectors(self._now, was, self._aims)
        facts = (solved, late, self._failed.copy(), self._frames.copy(), self._returns.copy())
        ended = Step(vectors, vectors, rewards.float(), *map(torch.from_numpy, facts))
        over = np.flatnonzero(solved | late)
        if not len(over):
            return ended
        self.recent.extend((bool(solved[row]), float(self._returns[row])) for row in over)
        return ended._replace(vectors=self._begin_again(over, vectors))

    def detach(self) -> None:
        """Forget the gradients of the steps so far."""
        self._scenes.detach()
        self._now, self._distance = self._now.detach(), self._distance.detach()

    def score(self, network: nn.Module) -> dict[str, float]:
        """Share of the last episodes that succeeded, and their mean return, if any has ended."""
        if not self.recent:
            return {}
        success, total = np.mean(self.recent, 0)
        return {"success": float(success), "return": float(total)}

    def note(self) -> str:
        """How many of the last episodes succeeded."""
        return f"{np.mean(self.recent, 0)[0]:.0%} solved" if self.recent else ""

    def state(self) -> dict[str, Any]:
        """Plain values by which the starts that follow can be drawn again."""
        random: dict[str, Any] = {**self._random.bit_generator.state}
        numbers = {name: str(value) for name, value in random.pop("state").items()}
        recent = [[int(won), value] for won, value in self.recent]
        return {"drawn": numbers, "random": random, "recent": recent}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on as when `state` was called; all scenes are to begin anew."""
        numbers = {name: int(value) for name, value in state["drawn"].items()}
        self._random.bit_generator.state = {**state["random"], "state": numbers}
        self.recent.clear()
        self.recent.extend((bool(won), value) for won, value in state["recent"])

    def close(self) -> None:
        """Free all resources."""
        self._scenes.close()

    def _followed(
        self, states: Mapping[str, Tensor], shown: States, frames: NDArray[np.int64]
    ) -> Tensor:
        """Zeros `[n]` whose gradients are those of the distances in some frames `[n]`."""
        rows = np.arange(self.number)
        seen = {name: shown[name][rows, frames] for name in self._watched}
        total = torch.zeros(self.number, dtype=torch.float64)
        for name, slope in slopes(self._task, seen, self._goals, self._watched).items():
            values = states[name][torch.from_numpy(rows), torch.from_numpy(frames)].double()
            change = (values - values.detach()).nan_to_num() * torch.from_numpy(slope)
            total = total + change.reshape(self.number, -1).sum(1)
        return torch.where(torch.from_numpy(frames >= 0), total, 0.0)

    def _drawn(self, number: int) -> list[int]:
        """Numbers of starts."""
        return [*map(int, self._random.integers(self._scenes.starts, size=number))]

    def _begin_again(self, rows: NDArray[np.int64], vectors: Tensor) -> Tensor:
        states, goals = self._scenes.begin(rows.tolist(), self._drawn(len(rows)))
        for row, goal in zip(rows, goals, strict=True):
            self._goals[row] = goal
        now, aims = side_by_side(states, self._inputs.state), self._fields_of(goals)
        chosen = torch.from_numpy(rows)
        self._aims = self._aims.index_copy(0, chosen, aims)
        self._now = self._now.index_copy(0, chosen, now)
        self._fresh(rows, states)
        return vectors.index_copy(0, chosen, self._inputs.vectors(now, now, aims))

    def _fresh(self, rows: NDArray[np.int64], states: States) -> None:
        """The distances of scenes that have just begun, with states `[k, …]`."""
        goals = [self._goals[row] for row in rows]
        one = {name: values[:, None] for name, values in states.items()}
        none, once = np.zeros(len(rows), np.bool_), np.ones(len(rows), np.int64)
        judged = judge(self._task, one, goals, np.full(len(rows), self._unit), none, once)
        distance = torch.from_numpy(judged.distance)
        self._distance = self._distance.index_copy(0, torch.from_numpy(rows), distance)
        self._failed[rows] = judged.failed
        self._frames[rows], self._returns[rows] = 0, 0.0

    def _fields_of(self, goals: Sequence[Goal]) -> Tensor:
        shapes = self._inputs.goal
        if not shapes:
            return torch.zeros(len(goals), 0, dtype=torch.float64)
        fields = {name: np.stack([np.asarray(g.state[name]) for g in goals]) for name in shapes}
        return side_by_side(fields, shapes)
