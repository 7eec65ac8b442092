"""Reads states from a latent frame, moves them by actions, and draws a latent frame from them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_recurrent.layers import CELLS, FrameDrawing, Overview

POINTS = 48
"""Places in the picture that a state is read from, beside what the cells show."""

HIDDEN = 256
"""Size of the hidden state that actions move, and of the hidden layers."""

ACTION = 16
"""Values that tell of the action in a video frame."""

STEP = 0.1
"""Scale of a change of states in a video frame, in standard deviations."""


class StateSight(Overview):
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


class StateMotion(nn.Module):
    """Moves states by the actions, one video frame at a time.

    Args:
        states: number of values S.
        following: how many of them, the last ones, follow from the others in every frame.
        width: size of the embedded actions.
        stride: video frames per latent frame, whose actions are embedded together.
    """

    def __init__(self, states: int, following: int, width: int, stride: int) -> None:
        super().__init__()
        self.moved = states - following
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

    def told(self, embedded: Tensor) -> Tensor:
        """Embedded actions `[B, L, width]` by video frames, `[B, L stride, ACTION]`.

        The first `stride` rows are of the first latent frame, which no action leads to.
        """
        with torch.autocast(embedded.device.type, enabled=False):  # errors of states add up
            told = self.actions(embedded.float())
        return told.reshape(len(told), -1, ACTION)

    def begin(self, states: Tensor) -> Tensor:
        """The hidden state `[B, HIDDEN]` of a scene that is as `[B, S]` says, and at rest."""
        return torch.tanh(self.start(states))

    def forward(self, action: Tensor, states: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """The states `[B, S]` one video frame later, and the hidden state."""
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


class StateDrawing(FrameDrawing):
    """Draws frames: the given one, with what moves as the states say.

    A map of the states is made from few coarse cells; blocks are told of the states too.

    Args:
        latent_channels: channels C of the latent.
        states: number of values S.
        stride: video frames per latent frame; a latent frame shows how things move within it.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by.
        blocks: number of residual blocks.
    """

    def __init__(
        self,
        latent_channels: int,
        states: int,
        *,
        stride: int,
        channels: int,
        width: int,
        blocks: int,
    ) -> None:
        super().__init__(latent_channels, channels, channels=channels, width=width, blocks=blocks)
        self.map = StateMap(states, channels)
        self.tell = nn.Sequential(
            nn.Linear((stride + 1) * states, width), nn.SiLU(), nn.Linear(width, width)
        )

    def canvas(self, base: Tensor, states: Tensor) -> Tensor:
        """What all frames start from, `[B, channels, h, w]`: the given frame and its states."""
        return self.stem(base) + self.then(self.map(states, base.shape[-2:]))

    def forward(self, canvas: Tensor, given: Tensor, states: Tensor) -> Tensor:
        """The change of the given latent frame, `[B, C, h, w]`.

        Args:
            canvas: see `canvas`.
            given: states in the given frame, `[B, S]`.
            states: in the video frames of the latent frame, the last one first: `[B, stride, S]`.
        """
        return self.change(
            canvas,
            self.map(states[:, 0], canvas.shape[-2:]),
            self.tell(torch.cat([given, states.flatten(1)], 1)),
        )


class StateMap(nn.Module):
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
