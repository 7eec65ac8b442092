"""`clone`: does what was done in recordings (behaviour cloning)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import nn

from acwm_core.errors import RecipeError
from acwm_planning.policies.networks import convolution
from acwm_planning.policies.saved import PolicyInputs
from acwm_policy.learner import Learner, Report
from acwm_policy.lesson import Lesson


class Clone(Learner):
    """Behaviour cloning: predicts the recorded actions from the recorded states or pictures.

    A step is a recorded moment that it looks at. With a task it also observes a goal, which in a
    recording is wherever the episode came later.

    Args:
        learning_rate: of Adam; it falls along a cosine every `usual_steps`, of pictures every
            eighth of them.
        net_arch: widths of the hidden layers.
        channels: of pictures, channels of the convolutions before them; each halves the sides.
        picture: longer side of the pictures, in pixels.
        batch_size: number of moments of a step of Adam.
        hold: number of frames for which an action is held; 4 are a latent frame.
        chunk: number of actions that are decided on at once and taken before the next decision.
        weight_decay: of AdamW.

    Raises:
        RecipeError: a number is out of range.
    """

    places = ("recordings",)
    usual_steps = 1_000_000

    def __init__(
        self,
        *,
        learning_rate: float = 1e-3,
        net_arch: Sequence[int] = (256, 256),
        channels: Sequence[int] = (16, 32, 32),
        picture: int = 48,
        batch_size: int = 256,
        hold: int = 4,
        chunk: int = 1,
        weight_decay: float = 1e-4,
    ) -> None:
        counts = {"batch_size": batch_size, "hold": hold, "chunk": chunk, "picture": picture}
        for name, value in counts.items():
            if value < 1:
                raise RecipeError(f"{name}={value}: give 1 or more")
        narrowest = min((*net_arch, *channels), default=1)
        if not learning_rate > 0 or not weight_decay >= 0 or narrowest < 1:
            raise RecipeError(
                "give a learning_rate above 0, a weight_decay of 0 or more, and "
                "widths net_arch and channels of 1 or more"
            )
        self.hold, self.chunk, self.picture, self._channels = hold, chunk, picture, (*channels,)
        self._rate, self._widths, self._batch = learning_rate, (*net_arch,), batch_size
        self._decay = weight_decay

    def begin(self, lesson: Lesson, seed: int) -> None:
        self._recordings = lesson.recordings
        inputs = lesson.measured.inputs
        self._period = self.usual_steps // 8 if inputs.picture else self.usual_steps
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            eyes, observed = _eyes(inputs, self._channels)
            sizes = (observed, *self._widths, self._recordings.action_size)
            layers = [layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), nn.ReLU())]
        self._network = nn.Sequential(*eyes, *layers[:-1], nn.Tanh())
        self._random = torch.Generator().manual_seed(seed)
        self._adam = torch.optim.AdamW(
            self._network.parameters(), self._rate, weight_decay=self._decay
        )

    def learn(self, steps: int, report: Report) -> None:
        while self.steps < steps:
            done = torch.tensor(torch.pi * (self.steps % self._period) / self._period)
            for group in self._adam.param_groups:
                group["lr"] = self._rate * (0.02 + 0.98 * (1 + done.cos().item()) / 2)
            vectors, actions = self._recordings.draw(self._batch, self._random)
            error = (self._network(vectors) - actions).square().mean()
            self._adam.zero_grad()
            error.backward()
            self._adam.step()
            self.steps += self._batch
            report(self._batch)

    def network(self) -> nn.Sequential:
        return self._network

    def state(self) -> dict[str, Any]:
        parts = {"network": self._network.state_dict(), "adam": self._adam.state_dict()}
        return {**parts, "random": self._random.get_state(), "steps": self.steps}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._network.load_state_dict(state["network"])
        self._adam.load_state_dict(state["adam"])
        self._random.set_state(state["random"])
        self.steps = state["steps"]


def _eyes(inputs: PolicyInputs, channels: Sequence[int]) -> tuple[list[nn.Module], int]:
    """Layers that look at pictures, none for states, and the number of values that they give."""
    if not inputs.picture:
        return [], inputs.size
    height, width = inputs.picture
    layers: list[nn.Module] = [nn.Unflatten(1, (inputs.channels, height, width))]
    for pair in pairwise((inputs.channels, *channels)):
        layers += [convolution(*pair), nn.ReLU()]
        height, width = -(-height // 2), -(-width // 2)
    return [*layers, nn.Flatten()], [inputs.channels, *channels][-1] * height * width
