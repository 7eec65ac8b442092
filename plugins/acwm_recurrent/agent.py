"""`AgentPath`: the agent's own state, read from a latent frame and moved by the actions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_core.model.objectives.objective import Batch, drawn_noise, sent

CELLS = 4
"""Cells per side to which a frame's features are pooled before the state is read from them."""

HIDDEN = 160
"""Size of the hidden state that the actions move."""

READ_FRAMES = 4
"""Frames of each clip from which it learns to read the state, as those of a clip are much alike."""

START_NOISE = 0.05
"""Noise on the true states that its motion is learned from, in standard deviations of the state."""


class Agent(NamedTuple):
    """What is known of the agent in one frame.

    Attributes:
        state: standardised, `[B, S]`.
        hidden: what moves it, `[B, HIDDEN]`.
    """

    state: Tensor
    hidden: Tensor


class AgentPath(nn.Module):
    """Knows where the agent is, by its state alone: few numbers, and no picture, are unrolled.

    It is trained by the true states only (`loss`): to read them from any latent frame, and to move
    them from a true start. So an error of the picture does not spoil what is known of the agent.

    Args:
        latent_channels: channels C of the latent.
        state_size: number of values S of the state.
        width: size of the embedded actions, and of the modulation.

    Attributes:
        embed: maps states `[…, S]` to a modulation `[…, width]`.
    """

    def __init__(self, latent_channels: int, state_size: int, width: int) -> None:
        super().__init__()
        self.look = nn.Sequential(
            nn.Conv2d(latent_channels, 64, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(64, 64, 3, padding=1),
            nn.SiLU(),
            nn.AdaptiveAvgPool2d(CELLS),
            nn.Conv2d(64, 96, 3, padding=1),
            nn.SiLU(),
        )
        self.see = nn.Sequential(
            nn.Linear(96 * CELLS**2, 256), nn.SiLU(), nn.Linear(256, state_size)
        )
        self.start_hidden = nn.Linear(state_size, HIDDEN)
        self.gru = nn.GRUCell(width + state_size, HIDDEN)
        self.change = nn.Linear(HIDDEN, state_size)
        self.embed = nn.Sequential(nn.Linear(state_size, width), nn.SiLU(), nn.Linear(width, width))

    def start(self, frame: Tensor) -> Agent:
        """The agent in a latent frame `[B, C, h, w]`."""
        return self.begin(self.read(frame))

    def read(self, frame: Tensor) -> Tensor:
        """The state that a latent frame `[B, C, h, w]` shows, `[B, S]`."""
        grid = self.look(frame.contiguous(memory_format=torch.channels_last))
        return self.see(grid.flatten(1)).float()

    def begin(self, state: Tensor) -> Agent:
        """The agent in a state `[B, S]`, as if at rest."""
        with torch.autocast(state.device.type, enabled=False):
            return Agent(state, torch.tanh(self.start_hidden(state)))

    def step(self, agent: Agent, action: Tensor) -> Agent:
        """The agent one latent frame later, given the embedded actions `[B, width]`."""
        # In full precision, as changes add up.
        with torch.autocast(action.device.type, enabled=False):
            driven = torch.cat([action.to(agent.state), agent.state], -1)
            hidden = self.gru(driven, agent.hidden)
            return Agent(agent.state + self.change(hidden), hidden)

    def loss(self, batch: Batch, actions: Tensor) -> Tensor:
        """Squared errors of the state that is read from frames, and of that moved from a true one.

        Args:
            batch: with the true states.
            actions: embedded, `[B, L, width]`.
        """
        states = batch.states
        assert states is not None
        picked = batch.picked(READ_FRAMES, states.shape[1])
        frames = batch.latents.take_along_dim(picked[..., None, None, None], 1)
        true = states.take_along_dim(picked[..., None], 1)
        read = functional.mse_loss(self.read(frames.flatten(0, 1)), true.flatten(0, 1))
        if not self.change.weight.requires_grad:
            return read  # its motion was learnt before
        noise = sent(drawn_noise(states.shape[2:], batch.generators), states)
        return read + self.motion_loss(states, actions, noise)

    def motion_loss(self, states: Tensor, actions: Tensor, noise: Tensor) -> Tensor:
        """Squared error of the states that actions lead to from a true one.

        Args:
            states: true ones, `[B, L, S]`.
            actions: embedded, `[B, L, width]`.
            noise: standard normal, `[B, S]`.
        """
        agent = self.begin(states[:, 0] + START_NOISE * noise)
        moved: list[Tensor] = []
        for frame in range(1, states.shape[1]):
            agent = self.step(agent, actions[:, frame])
            moved.append(agent.state)
        return functional.mse_loss(torch.stack(moved, 1), states[:, 1:])
