"""How actions move agents, and agents move bodies, from one video frame to the next."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_core.env.rotations import angle_code, angle_of_code
from acwm_scene.poses import Poses, turned, turned_back, waves, waves_size

HIDDEN = 64
"""Size of the hidden state by which an agent follows its actions."""

ACTION = 8
"""Values that tell an agent of an action."""

NEAR, WIDE = 5, 3
"""Octaves of the Fourier features of a distance between things, and of a place on the plane."""

STEP = 0.3
"""Scale of a change: about as far as an agent gets in a frame, in units."""

FASTEST = 1.0
"""No body moves further along an axis in a frame, in units, and none turns further, in rad: in
training a long window of a rare draw would grow without bounds."""


class Moving(NamedTuple):
    """Poses in one video frame and how they change.

    Attributes:
        poses: without the axis T.
        agent_change: of the agents' places since the frame before, `[B, A, 2]`.
        hidden: of the agents, `[B, A, HIDDEN]`.
        place_change: of the bodies' places, `[B, N, 2]`.
        spin: change of the bodies' angles in rad, `[B, N, 1]`.
        chance: numbers of each body that this draw of the future depends on, `[B, N, noise]`, of a
            model that draws.
    """

    poses: Poses
    agent_change: Tensor
    hidden: Tensor
    place_change: Tensor
    spin: Tensor
    chance: tuple[Tensor, ...] = ()


class AgentMotion(nn.Module):
    """Agents follow their actions whatever stands in their way.

    Args:
        agents: number of agents A.
        width: size of the embedded actions.
        stride: video frames per latent frame, whose actions are embedded together.
    """

    def __init__(self, agents: int, width: int, stride: int) -> None:
        super().__init__()
        self.agents, self.stride = agents, stride
        self.actions = nn.Linear(width, stride * agents * ACTION)
        self.gru = nn.GRUCell(ACTION + 4, HIDDEN)
        self.change = nn.Sequential(
            nn.Linear(HIDDEN + ACTION + 4, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 2)
        )

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions `[B, L, width]` by agents and video frames, `[B, L, stride, A, ACTION]`.

        The first `stride` rows are of the first latent frame, which no action leads to.
        """
        with torch.autocast(modulation.device.type, enabled=False):  # errors of places add up
            actions = self.actions(modulation.float())
        return actions.unflatten(-1, (-1, self.agents, ACTION))

    def forward(
        self, action: Tensor, places: Tensor, change: Tensor, hidden: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The change of the places `[B, A, 2]` in the next frame, and the hidden state."""
        inputs = torch.cat([action, places * STEP, change / STEP], -1).flatten(0, 1)
        hidden = self.gru(inputs, hidden.flatten(0, 1))
        change = STEP * self.change(torch.cat([hidden, inputs], -1))
        return change.view_as(places), hidden.view(*places.shape[:2], HIDDEN)


class BodyMotion(nn.Module):
    """Bodies are pushed by agents and by each other.

    Everything is seen from the body that moves, in its own frame, so that a push from any side and
    in any place teaches about all others. Two rounds of messages (Gilmer et al. 2017, arXiv
    1704.01212) let a body push another one within a frame. Only places on the plane tell it of
    walls.

    Args:
        channels: size of messages and of hidden layers.
        folds: in how many ways a body can be turned and look the same.
        noise: numbers of each body that what happens to it depends on, beside what is known.
    """

    def __init__(self, channels: int, folds: int, noise: int = 0) -> None:
        super().__init__()
        self.folds = folds
        near = waves_size(2, NEAR)
        self.own = nn.Linear(13 + waves_size(2, WIDE), channels)
        self.chance = nn.Linear(noise, channels, bias=False) if noise else None
        self.push = nn.Linear(2 * near + 2, channels)
        self.pushed = nn.Linear(channels, channels)
        self.pair = nn.Linear(near + 5, channels)
        self.paired = nn.Linear(channels, channels)
        self.moved = nn.Linear(3 * channels, channels)
        self.of_own, self.of_other = (nn.Linear(channels, channels, bias=False) for _ in range(2))
        self.chain = nn.Linear(channels, channels)
        self.chained = nn.Linear(channels, channels)
        self.last = nn.Linear(2 * channels, channels)
        self.out = nn.Linear(channels, 3)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, moving: Moving, agents: Tensor) -> Moving:
        """Move the bodies by one frame, while the agents move to `agents`, `[B, A, 2]`."""
        poses, change, spin = moving.poses, moving.place_change, moving.spin
        silu, places = functional.silu, poses.places
        frame = angle_code(angle_of_code(poses.turns, self.folds), 1)
        own = self.own(
            torch.cat(
                [
                    poses.present,
                    turned_back(places, frame),
                    frame,
                    turned_back(change, frame) / STEP,
                    spin / STEP,
                    poses.turns,
                    places.abs(),
                    waves(places, WIDE),
                    torch.ones_like(spin),
                ],
                -1,
            )
        )
        if self.chance:
            own = own + self.chance(*moving.chance)
        pushes = self._pushes(poses, agents, frame, own)
        pairs = silu(self.pair(self._pairs(poses, frame, change, spin)) + own[:, :, None])
        others = 1 - torch.eye(places.shape[1], device=places.device)[:, :, None]
        mask = poses.present[:, None] * others
        pulls = (silu(self.paired(pairs)) * mask).sum(2)
        moved = silu(self.moved(torch.cat([silu(own), pushes, pulls], -1)))
        pairs = silu(
            self.chain(pairs) + self.of_own(moved)[:, :, None] + self.of_other(moved)[:, None]
        )
        pulls = (silu(self.chained(pairs)) * mask).sum(2)
        changes = self.out(silu(self.last(torch.cat([moved, pulls], -1))))
        changes = changes.clamp(-FASTEST, FASTEST) * poses.present
        change, spin = turned(changes[..., :2], frame), changes[..., 2:]
        turns = turned(poses.turns, angle_code(spin[..., 0], self.folds))
        return moving._replace(
            poses=Poses(agents, poses.present, places + change, turns),
            agent_change=agents - poses.agents,
            place_change=change,
            spin=spin,
        )

    def _pushes(self, poses: Poses, agents: Tensor, frame: Tensor, own: Tensor) -> Tensor:
        """What the agents do to each body, `[B, N, channels]`."""
        seen = frame[:, :, None]
        before, after = (
            turned_back(places[:, None] - poses.places[:, :, None], seen)
            for places in (poses.agents, agents)
        )
        moves = torch.cat([waves(before, NEAR), waves(after, NEAR), (after - before) / STEP], -1)
        pushed = functional.silu(self.push(moves) + own[:, :, None])
        return functional.silu(self.pushed(pushed)).sum(2)

    def _pairs(self, poses: Poses, frame: Tensor, change: Tensor, spin: Tensor) -> Tensor:
        """What each body sees of each other one, `[B, N, N, …]`."""
        seen = frame[:, :, None]

        def between(values: Tensor) -> Tensor:
            return turned_back(values[:, None] - values[:, :, None], seen)

        apart = between(poses.places)
        aligned = turned_back(poses.turns[:, None].expand_as(apart), poses.turns[:, :, None])
        spins = spin[:, None].expand(*apart.shape[:3], 1)
        return torch.cat([waves(apart, NEAR), aligned, between(change) / STEP, spins / STEP], -1)
