"""Layers that read values from a latent frame, move them by actions, and paint them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.layers import CELLS, Overview, Painter

POINTS = 48
"""Places in the picture that a state is read from, beside what the cells show."""

HIDDEN = 256
"""Size of the hidden state that actions move, and of the hidden layers."""

ACTION = 16
"""Values that tell of the action in a video frame."""

STEP = 0.1
"""Scale of a change of states in a video frame, in standard deviations."""


class ValueSight(Overview):
    """Reads the states that a latent frame shows.

    Args:
        latent_channels: channels C of the latent.
        states: number of values S.
        channels: channels of its convolutions.
    """

    def __init__(self, latent_channels: int, states: int, channels: int) -> None:
        super().__init__(latent_channels, channels, POINTS)
        self.read = nn.Sequential(
            nn.Linear(self.size, HIDDEN),
            nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.SiLU(),
            nn.Linear(HIDDEN, states),
        )

    def forward(self, frame: Tensor) -> Tensor:
        """The states `[B, S]` in a latent frame `[B, C, h, w]`."""
        return self.read(self.summary(self.features(frame))).float()


class ValueMotion(nn.Module):
    """Moves states by the actions, one video frame at a time.

    Args:
        states: number of values S.
        following: how many of them, the last ones, follow from the others in every frame.
        width: size of the embedded actions.
        stride: video frames per latent frame, whose actions are embedded together.
        noise: numbers of a draw that the motion depends on; 0 for one future.
    """

    def __init__(
        self, states: int, following: int, width: int, stride: int, noise: int = 0
    ) -> None:
        super().__init__()
        self.moved = states - following
        self.chance = nn.Linear(noise, ACTION, bias=False) if noise else None
        self.actions = nn.Linear(width, stride * ACTION)
        self.start = nn.Linear(states, HIDDEN)
        self.gru = nn.GRUCell(ACTION + states, HIDDEN)
        self.change = nn.Sequential(
            nn.Linear(HIDDEN + ACTION + states, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, self.moved)
        )
        self.follow = (
            nn.Sequential(
                nn.Linear(self.moved, HIDDEN),
                nn.SiLU(),
                nn.Linear(HIDDEN, HIDDEN),
                nn.SiLU(),
                nn.Linear(HIDDEN, following),
            )
            if following
            else None
        )

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions `[B, L, width]` by video frames, `[B, L, stride, ACTION]`."""
        with torch.autocast(modulation.device.type, enabled=False):  # errors of values add up
            actions = self.actions(modulation.float())
        return actions.unflatten(-1, (-1, ACTION))

    def begin(self, states: Tensor) -> Tensor:
        """The hidden state `[B, HIDDEN]` of a scene that is as `[B, S]` says, and at rest."""
        return torch.tanh(self.start(states))

    def forward(
        self, action: Tensor, states: Tensor, hidden: Tensor, chance: tuple[Tensor, ...] = ()
    ) -> tuple[Tensor, Tensor]:
        """The values `[B, V]` one video frame later, and the hidden state."""
        if self.chance:
            action = action + self.chance(*chance)
        inputs = torch.cat([action, states], -1)
        hidden = self.gru(inputs, hidden)
        change = STEP * self.change(torch.cat([hidden, inputs], -1))
        moved = states[..., : self.moved] + change
        return (torch.cat([moved, self.follow(moved)], -1) if self.follow else moved), hidden

    def displaced(self, states: Tensor, change: Tensor) -> Tensor:
        """States `[…, S]` with a change of those that are moved; the others follow."""
        moved, following = states.split([self.moved, states.shape[-1] - self.moved], -1)
        other = moved + change[..., : self.moved]
        if self.follow is None:
            return other
        return torch.cat([other, following + self.follow(other) - self.follow(moved)], -1)


class ValuePainter(Painter):
    """Paints a map of the values, made from few coarse cells, and tells the blocks of them.

    Args:
        values: number of values V.
        stride: video frames per latent frame; a latent frame shows how things move within it.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by.
    """

    def __init__(self, values: int, *, stride: int, channels: int, width: int) -> None:
        super().__init__(channels, channels)
        self.map = ValueMap(values, channels)
        self.tell = nn.Sequential(
            nn.Linear((stride + 1) * values, width), nn.SiLU(), nn.Linear(width, width)
        )


class ValueMap(nn.Module):
    """A grid of features of a state.

    Args:
        states: number of values S.
        channels: channels of the grid.
    """

    def __init__(self, states: int, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.features = nn.Sequential(
            nn.Linear(states, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, channels * CELLS**2)
        )
        self.layers = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))

    def forward(self, states: Tensor, size: torch.Size) -> Tensor:
        """The grid `[B, channels, *size]` of states `[B, S]`."""
        grid = self.features(states).unflatten(1, (self.channels, CELLS, CELLS))
        sizes = ([-(-side // 2) for side in size], list(size))
        for layer, within in zip(self.layers, sizes, strict=True):
            grid = layer(functional.silu(functional.interpolate(grid, size=within)))
        return grid
