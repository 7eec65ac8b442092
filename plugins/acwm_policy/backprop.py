"""`backprop`: gradients through the dream, by a short-horizon actor-critic."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, TrainingError
from acwm_policy.episodes import Step
from acwm_policy.learner import Learner, Report
from acwm_policy.lesson import Lesson


class Passed(NamedTuple):
    """A step of n scenes without gradients, for the critic: `[n, O]`, and `[n]` each."""

    vectors: Tensor
    last: Tensor
    rewards: Tensor
    solved: Tensor
    over: Tensor


class Backprop(Learner):
    """Short-horizon actor-critic (SHAC; Xu et al. 2022, arXiv 2204.07137).

    In a dream, a reward is a differentiable function of the actions that led to it: the model moves
    the states by matrix products, and the task's distance has slopes. So the policy climbs the
    gradient of its own return over a few steps, after which a critic says what is still to come.
    Longer chains of steps would have gradients that explode; the critic also smooths what has no
    gradient, such as the bonus for success.

    Args:
        horizon: number of steps through which gradients pass.
        learning_rate: of policy and critic, by Adam.
        net_arch: widths of the hidden layers of policy and critic.
        gamma: factor by which a reward counts less with each step.
        lam: share λ of longer returns in the critic's aims (TD(λ)).
        noise: standard deviation of the first actions, before they are limited to [-1, 1]; it is
            learnt.
        clip: largest norm of the policy's gradient.
        critic_rounds: how often the critic goes through the steps of a horizon, in four parts.
        average: share of the old critic that is kept in the averaged one after each horizon.

    Raises:
        RecipeError: a number is out of range.
    """

    places = ("dream",)

    def __init__(
        self,
        *,
        horizon: int = 6,
        learning_rate: float = 1e-3,
        net_arch: Sequence[int] = (128, 128),
        gamma: float = 0.98,
        lam: float = 0.95,
        noise: float = 0.4,
        clip: float = 1.0,
        critic_rounds: int = 4,
        average: float = 0.8,
    ) -> None:
        above = {"learning_rate": learning_rate, "noise": noise, "clip": clip}
        shares = {"gamma": gamma, "lam": lam, "average": average}
        for name, value in {"horizon": horizon, "critic_rounds": critic_rounds}.items():
            if value < 1:
                raise RecipeError(f"{name}={value}: give 1 or more")
        for name, value in above.items():
            if not value > 0:
                raise RecipeError(f"{name}={value}: give a number above 0")
        for name, value in shares.items():
            if not 0 <= value <= 1:
                raise RecipeError(f"{name}={value}: give a number from 0 to 1")
        if min(net_arch, default=1) < 1:
            raise RecipeError(f"net_arch={[*net_arch]}: give widths of 1 or more")
        self._horizon, self._rate, self._widths = horizon, learning_rate, (*net_arch,)
        self._gamma, self._lam, self._noise, self._clip = gamma, lam, noise, clip
        self._rounds, self._average = critic_rounds, average

    def begin(self, lesson: Lesson, seed: int) -> None:
        episodes = self._episodes = lesson.episodes
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            sizes = (episodes.observed, *self._widths)
            own = _layers(*sizes, episodes.action_size)
            own[-1].weight.data.mul_(0.1)  # so that the first actions are small
            self._actor = nn.Sequential(*own, nn.Tanh())
            self._critic = nn.Sequential(*_layers(*sizes, 1))
        self._averaged = copy.deepcopy(self._critic).requires_grad_(False)
        deviations = torch.full((episodes.action_size,), self._noise).log()
        self._deviations = nn.Parameter(deviations)
        self._random = torch.Generator().manual_seed(seed)
        climbing = [*self._actor.parameters(), self._deviations]
        self._climbing = torch.optim.Adam(climbing, self._rate, betas=(0.7, 0.95))
        self._judging = torch.optim.Adam(self._critic.parameters(), self._rate, betas=(0.7, 0.95))

    def learn(self, steps: int, report: Report) -> None:
        vectors = self._episodes.begin()
        while self.steps < steps:
            vectors, passed = self._climb(vectors)
            self._judge(passed)
            self.steps += self._horizon * self._episodes.number
            report(self._horizon * self._episodes.number)

    def _climb(self, vectors: Tensor) -> tuple[Tensor, list[Passed]]:
        """Act for a horizon and improve the policy; what is observed then, and what was."""
        self._episodes.detach()
        vectors, passed = vectors.detach(), list[Passed]()
        factor, total = torch.ones(self._episodes.number), torch.zeros(())
        for _ in range(self._horizon):
            before, step = vectors, self._episodes.step(self._explore(vectors))
            total = total + (factor * step.rewards).sum()
            factor = factor * self._gamma
            # An episode whose time is over would go on, so the critic speaks for the rest of it.
            total = total + (factor * self._averaged(step.last)[:, 0])[step.late].sum()
            factor, vectors = torch.where(step.over, 1.0, factor), step.vectors
            passed.append(_without_gradients(before, step))
        total = total + (factor * self._averaged(vectors)[:, 0])[~passed[-1].over].sum()
        self._climbing.zero_grad()
        (-total / (self._horizon * self._episodes.number)).backward()
        own = [*self._actor.parameters(), self._deviations]
        if not nn.utils.clip_grad_norm_(own, self._clip).isfinite():
            raise TrainingError(
                f"the gradient through the dream is not finite after {self.steps} steps: take a "
                "smaller learning_rate or horizon, or another algorithm"
            )
        self._climbing.step()
        return vectors, passed

    def _explore(self, vectors: Tensor) -> Tensor:
        """Actions `[n, A]` around those of the policy."""
        means = self._actor[:-1](vectors)
        noise = torch.randn(means.shape, generator=self._random)
        return torch.tanh(means + self._deviations.exp() * noise)

    def _judge(self, passed: Sequence[Passed]) -> None:
        """Fit the critic to the returns of a horizon, and the averaged critic to it."""
        aims, vectors = self._aims(passed).flatten(), torch.cat([step.vectors for step in passed])
        for _ in range(self._rounds):
            for rows in torch.randperm(len(aims), generator=self._random).chunk(4):
                error = (self._critic(vectors[rows])[:, 0] - aims[rows]).square().mean()
                self._judging.zero_grad()
                error.backward()
                self._judging.step()
        with torch.no_grad():
            for kept, new in zip(
                self._averaged.parameters(), self._critic.parameters(), strict=True
            ):
                kept.lerp_(new, 1 - self._average)

    @torch.no_grad()
    def _aims(self, passed: Sequence[Passed]) -> Tensor:
        """Returns that mix all lengths (TD(λ)), `[H, n]`."""
        aims = list[Tensor]()
        for step in reversed(passed):
            after = self._averaged(step.last)[:, 0] * ~step.solved
            longer = aims[-1] if aims else after
            mixed = torch.where(step.over, after, torch.lerp(after, longer, self._lam))
            aims.append(step.rewards + self._gamma * mixed)
        return torch.stack(aims[::-1])

    def network(self) -> nn.Sequential:
        return self._actor

    def state(self) -> dict[str, Any]:
        parts = self._parts()
        states = {name: part.state_dict() for name, part in parts.items()}
        random, deviations = self._random.get_state(), self._deviations.detach().clone()
        return {**states, "deviations": deviations, "random": random, "steps": self.steps}

    def restore(self, state: Mapping[str, Any]) -> None:
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self._deviations.data = state["deviations"].clone()
        self._random.set_state(state["random"])
        self.steps = state["steps"]

    def _parts(self) -> dict[str, Any]:
        networks = {"actor": self._actor, "critic": self._critic, "averaged": self._averaged}
        return {**networks, "climbing": self._climbing, "judging": self._judging}


def _layers(*sizes: int) -> list[Any]:
    """Linear layers of these sizes, with a rectifier between."""
    layers = [layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), nn.ReLU())]
    return layers[:-1]


def _without_gradients(vectors: Tensor, step: Step) -> Passed:
    facts = (vectors.detach(), step.last.detach(), step.rewards.detach())
    return Passed(*facts, step.solved, step.over)
