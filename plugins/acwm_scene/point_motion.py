"""Moves points: some with the actions, others because these push them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.poses import waves, waves_size

ACTION = 32
"""Values that tell of the actions of a latent frame."""

PHASES, HIDDEN = 16, 96
"""Phases that actions move and points follow, and the size of the layers that move them."""

IDENTITY, MEMORY, CHANNELS, OCTAVES = 16, 48, 32, 3
"""Of the interaction of points: numbers that tell one point from another, the size of what each
remembers, that of the hidden layers, and frequencies in which distances are seen."""

UNITS = 4.0
"""Units of `waves` in half the width of a picture, so that the longest wave is a picture long."""

STEP = 0.3
"""Scale of a change in a latent frame."""

LIMIT = 1.2
"""Largest number of a point; what is read lies from −1 to 1."""


class Points(NamedTuple):
    """The state of points in a latent frame.

    Attributes:
        points: where they are and what they look like, `[B, K, 2 + F]`.
        given: the same in the given frame.
        scene: what is to be known of the given frame, `[B, HIDDEN]`.
        led: where the phases of the given frame lead the points, `[B, K, 2 + F]`.
        phases: the numbers that actions move, in rad, `[B, PHASES]`.
        rates: how far they move in a latent frame, `[B, PHASES]`.
        pushed: how far interactions have moved each point, `[B, K, 2 + F]`.
        memory: of each point, `[B, K, MEMORY]`.
        chance: numbers that this future depends on, `[B, noise]`, of a model that draws.
    """

    points: Tensor
    given: Tensor
    scene: Tensor
    led: Tensor
    phases: Tensor
    rates: Tensor
    pushed: Tensor
    memory: Tensor
    chance: tuple[Tensor, ...] = ()


def bounded(points: Tensor) -> Tensor:
    """Points within `LIMIT`, with slopes as if they were not.

    Without it, errors that push one another grow without end in long windows, and training fails.
    """
    return points + (points.clamp(-LIMIT, LIMIT) - points).detach()


class PointMotion(nn.Module):
    """Two ways in which points move, which are added.

    Actions accelerate a few phases, and points follow these and the given frame: so errors of
    points that belong together, as those of one arm do, do not add up one by one. Phases wrap, as
    the angles of joints do, and have a rate, as what has mass does. And each point gets messages
    from all others, as in an interaction network (Battaglia et al. 2016, arXiv 1612.00222): so
    things are pushed.

    Args:
        points: number of points K.
        features: number of features F of each.
        width: size of the embedded actions.
        noise: numbers of a draw that the motion depends on; 0 for one future.
        declared: numbers that tell what declared things do in a latent frame.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, points: int, features: int, width: int, noise: int = 0, declared: int = 0
    ) -> None:
        super().__init__()
        self.points, entries = points, 2 + features
        size = points * entries
        self.register_buffer("mean", torch.zeros(points, entries))
        self.register_buffer("std", torch.ones(points, entries))
        self.actions = nn.Linear(width, ACTION)
        self.chance = nn.Linear(noise, ACTION, bias=False) if noise else None
        self.declared = (
            nn.Sequential(nn.Linear(declared, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, ACTION))
            if declared
            else None
        )
        self.phases = nn.Sequential(
            nn.Linear(size, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 2 * PHASES)
        )
        self.rates = nn.Linear(2 * size, PHASES)
        self.accelerate = nn.Sequential(
            nn.Linear(3 * PHASES + ACTION, HIDDEN),
            nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.SiLU(),
            nn.Linear(HIDDEN, 2 * PHASES),
        )
        self.by_phases, self.by_scene = nn.Linear(2 * PHASES, HIDDEN), nn.Linear(size, HIDDEN)
        self.follow = nn.Sequential(
            nn.Linear(2 * HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, size)
        )
        self.identity = nn.Parameter(torch.randn(points, IDENTITY))
        own = IDENTITY + entries
        self.remember = nn.Linear(own + entries, MEMORY)
        self.apart = nn.Linear(waves_size(2, OCTAVES), CHANNELS)
        self.receiver, self.sender = (nn.Linear(own + MEMORY + ACTION, CHANNELS) for _ in range(2))
        self.message = nn.Linear(CHANNELS, CHANNELS)
        self.update = nn.GRUCell(own + ACTION + CHANNELS + waves_size(2, OCTAVES), MEMORY)
        self.push = nn.Sequential(
            nn.Linear(MEMORY + own + ACTION + CHANNELS, CHANNELS),
            nn.SiLU(),
            nn.Linear(CHANNELS, entries),
        )

    def embed(self, modulation: Tensor) -> Tensor:
        """The actions of latent frames `[B, L, width]`, `[B, L, ACTION]`."""
        with torch.autocast(modulation.device.type, enabled=False):  # errors add up
            return self.actions(modulation.float())

    def begin(self, points: Tensor, change: Tensor) -> Points:
        """The state of points `[B, K, 2 + F]` that changed so since the latent frame before."""
        values = ((points - self.mean) / self.std).flatten(1)
        sines, cosines = self.phases(values).chunk(2, 1)
        phases, scene = torch.atan2(sines, cosines), functional.silu(self.by_scene(values))
        change = change / self.std
        memory = torch.tanh(self.remember(torch.cat([self._own(points), change], -1)))
        return Points(
            points,
            given=points,
            scene=scene,
            led=self._led(phases, scene),
            phases=phases,
            rates=self.rates(torch.cat([values, change.flatten(1)], 1)),
            pushed=torch.zeros_like(points),
            memory=memory,
        )

    def forward(self, action: Tensor, state: Points) -> Points:
        """The state one latent frame later, by embedded actions `[B, ACTION]`."""
        if self.chance:
            action = action + self.chance(*state.chance)
        inputs = [state.phases.cos(), state.phases.sin(), state.rates, action]
        faster, further = (STEP * self.accelerate(torch.cat(inputs, 1))).chunk(2, 1)
        phases = state.phases + state.rates + further
        push, memory = self._pushed(state.points, state.memory, action)
        led = state.given + self._led(phases, state.scene) - state.led
        points = bounded(led + state.pushed + STEP * push)
        return state._replace(
            points=points,
            phases=phases,
            rates=state.rates + faster,
            pushed=points - led,
            memory=memory,
        )

    def _led(self, phases: Tensor, scene: Tensor) -> Tensor:
        moved = functional.silu(self.by_phases(torch.cat([phases.cos(), phases.sin()], 1)))
        return self.follow(torch.cat([moved, scene], 1)).view(-1, *self.std.shape) * self.std

    def _own(self, points: Tensor) -> Tensor:
        return torch.cat([self.identity.expand(len(points), -1, -1), points], -1)

    def _pushed(self, points: Tensor, memory: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """How far messages from all others move each point, `[B, K, 2 + F]`; and its memory."""
        own = self._own(points)
        action = action[:, None].expand(-1, self.points, -1)
        node = torch.cat([own, memory, action], -1)
        places = UNITS * points[..., :2]
        apart = self.apart(waves(places[:, None] - places[:, :, None], OCTAVES))
        edges = apart + self.receiver(node)[:, :, None] + self.sender(node)[:, None]
        messages = functional.silu(self.message(functional.silu(edges).mean(2)))
        inputs = torch.cat([own, action, messages], -1)
        seen = torch.cat([inputs, waves(places, OCTAVES)], -1)
        memory = self.update(seen.flatten(0, 1), memory.flatten(0, 1)).view_as(memory)
        return self.push(torch.cat([memory, inputs], -1)), memory
