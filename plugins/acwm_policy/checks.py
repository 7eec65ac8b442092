"""Checks of a learner: what training, resuming and saving a policy require."""

from __future__ import annotations

import copy
import functools
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from acwm_core.checks.disc import Disc
from acwm_core.checks.result import Suite, expect, expect_equal, expect_is_a
from acwm_core.env.environment import Environment
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task
from acwm_planning.policies.networks import layers_of
from acwm_planning.policies.saved import PolicyInputs
from acwm_policy.episodes import Episodes
from acwm_policy.learner import Learner
from acwm_policy.lesson import Lesson, Measured, Place
from acwm_policy.recordings import Recorded, Recordings
from acwm_policy.scenes import Scenes, States

SCENES, REPEAT, SPEED = 8, 2, 0.04
STAGE = 256
"""Number of steps of a stage of a trial."""


class Glide(Scenes):
    """Points that glide as actions say, in PyTorch, so that gradients pass; never out of reach."""

    starts, repeat = 64, REPEAT

    def __init__(self) -> None:
        super().__init__(SCENES)
        places = np.random.default_rng(0).uniform(-0.2, 0.2, (2, self.starts, 2))
        self._begun, self._goals = places
        self._places = torch.zeros(SCENES, 2)

    def begin(self, which: Sequence[int], starts: Sequence[int]) -> tuple[States, list[Goal]]:
        begun = torch.from_numpy(self._begun[[*starts]]).float()
        self._places = self._places.index_copy(0, torch.tensor([*which]), begun)
        nothing = np.zeros((1, 1), np.uint8), np.zeros((1, 1, 3), np.uint8)
        goals = [Goal({"position": self._goals[start]}, *nothing) for start in starts]
        return {"position": begun.numpy()}, goals

    def step(self, actions: NDArray[np.float32]) -> States:
        return {name: v.numpy() for name, v in self.move(torch.from_numpy(actions)).items()}

    def move(self, actions: Tensor) -> dict[str, Tensor]:
        passed = [self._places + SPEED * (k + 1) * actions for k in range(REPEAT)]
        self._places = passed[-1]
        return {"position": torch.stack(passed, 1)}

    def detach(self) -> None:
        self._places = self._places.detach()


class ToTheGoal(Task):
    """A point to where it is to be."""

    name, summary, unit, tolerance, max_steps = "goal", "a point at its goal", "m", 0.02, 12

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        raise NotImplementedError  # the scenes have theirs

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        away = np.asarray(seen.states["position"]) - np.asarray(goal.state["position"])
        return np.linalg.norm(away, axis=-1)


class LearnerChecks(Suite):
    """Checks of an `acwm_policy.learner.Learner` on points that are to go to a place."""

    kind = "learner"

    def _lesson(self, place: Place | None = None) -> Lesson:
        shapes = {"position": [2]}
        inputs = PolicyInputs(shapes, shapes, [0.0] * 4, [0.12] * 4, [0.08] * 2)
        options = {"unit": 0.2, "bonus": 0.5, "watched": ["position"]}
        source: Episodes | Recordings = Episodes(Glide(), ToTheGoal(), Disc.card, inputs, **options)
        chosen: Place = place or self.target.places[0]
        if chosen == "recordings":
            hold, chunk = self.make().hold, self.make().chunk
            source = Recordings(_recorded(8), _recorded(2), inputs, hold, chunk)
        return Lesson(Disc.card, "goal", REPEAT, chosen, Measured(inputs, 0.2), source)

    def _begun(self, seed: int = 0) -> tuple[Learner, Lesson]:
        learner, lesson = self.make(), self._lesson()
        learner.begin(lesson, seed)
        return learner, lesson

    def _taught(self, seed: int = 0) -> nn.Sequential:
        learner, _ = self._begun(seed)
        learner.learn(STAGE, lambda _: None)
        return learner.network()

    @functools.cached_property
    def _usual(self) -> nn.Sequential:
        return copy.deepcopy(self._taught())

    def learns_a_policy(self) -> None:
        """Construct the learner, learn for a stage, and save the policy's layers."""
        learner, _ = self._begun()
        expect_is_a(learner, Learner)
        reported = list[int]()
        learner.learn(STAGE, reported.append)
        expect(learner.steps >= STAGE, f"after {STAGE} steps it counts {learner.steps}")
        expect_equal("it reports", sum(reported), learner.steps)
        expect_is_a(learner.network(), nn.Sequential)
        layers_of(learner.network())

    def actions_lie_within_their_bounds(self) -> None:
        """Give actions `[N, A]` from −1 to 1 for any observations, such as the largest."""
        actions = _acted(self._usual, 4.0)
        expect_equal("actions are", tuple(actions.shape), (256, Disc.card.action.size))
        expect(actions.isfinite().all(), "an action is not finite")
        expect(actions.abs().max() <= 1 + 1e-6, f"an action is {actions.abs().max():.3g}")

    def decides_by_its_seed(self) -> None:
        """Learn the same again with the same seed, and something else with another one."""
        usual, again, other = (
            _acted(net, 1.0) for net in (self._usual, self._taught(), self._taught(1))
        )
        expect(torch.equal(usual, again), "the same seed gives another policy")
        expect(not torch.equal(usual, other), "another seed gives the same policy")

    def resumes_exactly(self) -> None:
        """Go on from a saved state as if nothing had been."""
        learner, lesson = self._begun()
        learner.learn(STAGE, lambda _: None)
        stored = _stored({"learner": learner.state(), "source": lesson.source.state()})
        learner.learn(2 * STAGE, lambda _: None)
        other, again = self._begun()
        other.restore(stored["learner"])
        again.source.restore(stored["source"])
        expect(other.steps >= STAGE, f"after {STAGE} steps, it goes on from {other.steps}")
        other.learn(2 * STAGE, lambda _: None)
        same = torch.equal(*(_acted(trained.network(), 1.0) for trained in (learner, other)))
        expect(same, "a learner that goes on from a saved state learns another policy")

    def learns_to_come_closer(self) -> None:
        """After a few stages, end closer to the goals than standing still."""
        learner, _ = self._begun()
        learner.learn(8 * STAGE, lambda _: None)
        network, episodes = learner.network(), self._lesson("dream").episodes
        vectors = episodes.begin(range(SCENES))
        start, ends = episodes.distances, np.full(SCENES, np.nan)
        with torch.no_grad():
            for _ in range(ToTheGoal.max_steps // REPEAT):
                step = episodes.step(network(vectors))
                done = step.over.numpy() & np.isnan(ends)
                ends[done] = (start - 0.2 * (step.returns - 0.5 * step.solved).numpy())[done]
                vectors = step.vectors
        share = float(ends.mean() / start.mean())
        expect(share < 0.8, f"its policy ends at {share:.0%} of the distance of the start")


def _recorded(number: int) -> list[Recorded]:
    """Recordings of points that go straight to some place, and of what leads there."""
    random, recordings = np.random.default_rng(number), list[Recorded]()
    for _ in range(number):
        begun, end = random.uniform(-0.2, 0.2, (2, 2))
        actions = np.tile((end - begun) / (12 * SPEED), (13, 1))
        states = torch.from_numpy(begun + SPEED * np.arange(13)[:, None] * actions)
        recordings.append(Recorded(states, states, torch.from_numpy(actions)))
    return recordings


def _acted(network: nn.Sequential, spread: float) -> Tensor:
    """The actions for random observations `[256, 6]`."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        return network(spread * torch.randn(256, 6, generator=generator))


def _stored(state: dict[str, Any]) -> dict[str, Any]:
    """The same after it was in a file of plain values."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


check_learner = LearnerChecks.check
