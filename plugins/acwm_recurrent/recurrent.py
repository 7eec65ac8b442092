"""A deterministic recurrent predictor of the next latent frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.model.objectives.objective import Batch, drawn_noise, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.agent import Agent, AgentPath
from acwm_recurrent.layers import FilmBlock, MatrixConv, channel_norm

START_CELLS, STEP_CELLS = 4, 2
"""Cells per side that the grid is pooled to: for the initial vector, and at every step."""


class State(NamedTuple):
    """The state that is passed from one latent frame to the next.

    Attributes:
        grid: features of each place, `[B, channels, h, w]`.
        vector: features of the whole scene, `[B, width]`.
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
        draw: which of the possible futures it is, `[B, noise]`; empty if there is one only.
        agent: what is known of the agent, `[B, S]` and `[B, hidden]`; empty without states.
    """

    grid: Tensor
    vector: Tensor
    base: Tensor
    draw: tuple[Tensor, ...] = ()
    agent: tuple[Tensor, ...] = ()


class RecurrentModel(Predictor):
    """Unrolls a state from the given latent frame, one step per latent frame.

    The state has two parts. The grid has a cell for each patch of the latent; the coordinates of
    the cells are among its inputs. The vector is updated by a GRU from the embedded actions and the
    pooled grid. Residual convolution blocks, modulated by the vector, update the grid. A predicted
    frame is the given frame plus what further blocks and a last convolution read from the grid.

    The blocks that read serve all frames at once, and cost less than those of a step. Without
    blocks of a step, the grid stays that of the given frame and only the vector moves: enough where
    all that moves is the agent.

    With the agent's states to learn from (`data.states`), it also knows the agent by its state
    alone, see `AgentPath`, and both kinds of block are told.

    With `noise` it draws one of several futures: standard normal numbers, drawn once per rollout,
    are told to all blocks in every frame (arXiv 2506.10772). What makes different draws differ as
    much as true futures do is the objective, `energy_score`.

    With several given frames it starts from the last one and from the change just before it, which
    shows velocities.

    Args:
        latent_channels: channels C of the codec.
        state_size: number of values S of the agent's state; 0 if there are none to learn.
        channels: channels of the grid.
        width: size of the vector and of the conditioner's modulation.
        blocks: number of residual blocks per step.
        reading_blocks: number of residual blocks that read a frame from the grid.
        patch_size: side of a patch in latent pixels.
        noise: numbers that a draw depends on; 0 for a model that predicts one future.

    Raises:
        RecipeError: a size below 1, or a model without blocks.
    """

    layers, heads = 0, 1
    causal = streams = skips = True

    def __init__(
        self,
        *,
        latent_channels: int,
        state_size: int = 0,
        channels: int = 64,
        width: int = 192,
        blocks: int = 2,
        reading_blocks: int = 0,
        patch_size: int = 1,
        noise: int = 0,
    ) -> None:
        super().__init__()
        if min(channels, width, patch_size) < 1 or min(blocks, reading_blocks, noise) < 0:
            raise RecipeError(
                "channels, width and patch_size of a recurrent model must be at least 1, and its "
                "numbers of blocks and of noise at least 0"
            )
        if not blocks + reading_blocks:
            raise RecipeError("a recurrent model needs blocks, or reading_blocks")
        self.latent_channels = latent_channels
        self.width = width
        self.patch_size = patch_size
        patch_values = latent_channels * patch_size**2
        self.stem = nn.Conv2d(2 * patch_values + 2, channels, 3, padding=1)
        self.start_vector = nn.Linear(channels * START_CELLS**2, width)
        self.start_block = FilmBlock(channels, width)
        self.read_grid = nn.Linear(channels * STEP_CELLS**2, width)
        self.gru = nn.GRUCell(2 * width, width)
        self.blocks = nn.ModuleList(FilmBlock(channels, width) for _ in range(blocks))
        self.reading_blocks = nn.ModuleList(
            FilmBlock(channels, width) for _ in range(reading_blocks)
        )
        self.head = MatrixConv(channels, channels)
        self.out = nn.Conv2d(channels, patch_values, 1)
        for parameter in self.out.parameters():
            nn.init.zeros_(parameter)
        self.agent = AgentPath(latent_channels, state_size, width) if state_size else None
        self.noise, self.samples = noise, noise > 0
        self.future = (
            nn.Sequential(nn.Linear(noise, width), nn.SiLU(), nn.Linear(width, width))
            if noise
            else None
        )

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        *,
        only: Tensor | None = None,
        generators: Sequence[torch.Generator] = (),
    ) -> Latent:
        """Predict the latent frames after the given ones, `[B, L − K, C, h, w]`.

        All are unrolled, and with `only` none but those `[B, N]` is read.
        """
        known = given.shape[1]
        actions = self.actions(conditioning)
        state = self.start(given, actions[:, 0], self._draw(given, generators))
        grids: list[Tensor] = []
        modulations: list[Tensor] = []
        for frame in range(known, frames):
            state, modulation = self.step(state, actions[:, frame])
            grids.append(state.grid)
            modulations.append(modulation)
        grid, modulation = (_picked(each, only).flatten(0, 1) for each in (grids, modulations))
        changes = self._read(grid, modulation).unflatten(0, (len(given), -1))
        return state.base[:, None] + changes

    def state_loss(self, batch: Batch) -> Tensor:
        """The loss of what it knows of the agent; see `AgentPath.loss`."""
        assert self.agent is not None
        return self.agent.loss(batch, self.actions(batch.conditioning))

    def motion_loss(
        self,
        states: Tensor,
        conditioning: Conditioning,
        random: torch.Generator,
        *,
        progress: float,
    ) -> Tensor:
        """The loss of how actions move the agent; see `AgentPath.motion_loss`."""
        assert self.agent is not None
        noise = sent(torch.randn(states[:, 0].shape, generator=random), states)
        return self.agent.motion_loss(states, self.actions(conditioning), noise)

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[torch.Generator] = ()
    ) -> LatentStream:
        """Stream from the state. `context` is ignored, as the state holds all that is known."""
        return _RecurrentStream(self, given, self._draw(given, generators))

    def matrices(self) -> list[nn.Parameter]:
        """The weights of the convolutions in the blocks and in the head."""
        convolutions = [m for m in self.modules() if isinstance(m, MatrixConv)]
        return [c.weight for c in convolutions if c.weight.requires_grad]

    def _draw(self, given: Latent, generators: Sequence[torch.Generator]) -> tuple[Tensor, ...]:
        """A draw of one of the futures, `[B, noise]`."""
        if not self.noise:
            return ()
        return (sent(drawn_noise((self.noise,), generators), given),)

    def start(self, given: Latent, first: Tensor, draw: tuple[Tensor, ...] = ()) -> State:
        """The state after the last of the given frames `[B, K, C, h, w]`.

        Args:
            given: latents of the given frames.
            first: the conditioner's output for a frame that no action leads to, `[B, width]`.
            draw: see `State`.
        """
        shape = list(given.shape)
        if given.ndim != 5 or shape[2] != self.latent_channels:
            raise ShapeError(
                f"RecurrentModel takes latents [B, L, {self.latent_channels}, h, w], not {shape}"
            )
        if shape[3] % self.patch_size or shape[4] % self.patch_size:
            raise ShapeError(
                f"RecurrentModel cuts latents into patches of {self.patch_size}, which "
                f"{shape[3]}×{shape[4]} does not divide into; choose another frame size or "
                "patch_size=1"
            )
        base = given[:, -1]
        change = base - given[:, -2] if shape[1] > 1 else torch.zeros_like(base)
        cells = functional.pixel_unshuffle(torch.cat([base, change], 1), self.patch_size)
        grid = self.stem(torch.cat([cells, _coordinates(cells)], 1))
        grid = grid.contiguous(memory_format=torch.channels_last)
        pooled = functional.adaptive_avg_pool2d(grid, START_CELLS).flatten(1)
        vector = torch.tanh(self.start_vector(pooled) + first)
        agent = self.agent.start(base) if self.agent else ()
        return State(self.start_block(grid, vector), vector, base, draw, tuple(agent))

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The state one latent frame later, and the modulation `[B, width]` that reads it.

        Args:
            state: state of the previous frame.
            action: the embedded actions that lead to the next frame, `[B, width]`.
        """
        agent = state.agent
        if self.agent:
            # Only true states teach it: the picture's error must not bend what is known of it.
            with torch.no_grad():
                agent = self.agent.step(Agent(*agent), action)
            action = action + self.agent.embed(agent.state)
        if self.future:
            action = action + self.future(*state.draw)
        pooled = functional.adaptive_avg_pool2d(state.grid, STEP_CELLS).flatten(1)
        vector = self.gru(torch.cat([action, self.read_grid(pooled)], -1), state.vector)
        grid = state.grid
        for block in self.blocks:
            grid = block(grid, vector + action)
        return State(grid, vector, state.base, state.draw, tuple(agent)), vector + action

    def initial_state(
        self, given: Latent, conditioning: Conditioning, *draw: Tensor
    ) -> tuple[Tensor, ...]:
        """The first state of a stream that begins with latents `[B, K, C, h, w]`, as tensors.

        `conditioning` starts at the first latent frame, and may be longer. `draw` is the noise of a
        model that draws, `[B, noise]`.
        """
        return _tensors(self.start(given, self.actions(conditioning)[:, 0], draw))

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent frame `[B, 1, C, h, w]` and its state, given the last conditioning."""
        grid, vector, base, *rest = state
        drawn = 1 if self.noise else 0
        before = State(grid, vector, base, tuple(rest[:drawn]), tuple(rest[drawn:]))
        moved, modulation = self.step(before, self.actions(conditioning)[:, -1])
        frame = base + self._read(moved.grid, modulation).to(base)
        return frame[:, None], _tensors(moved)

    def _read(self, grid: Tensor, modulation: Tensor) -> Tensor:
        grid = grid.contiguous(memory_format=torch.channels_last)
        for block in self.reading_blocks:
            grid = block(grid, modulation)
        # As a matrix, a 1×1 kernel has gradients of its own strides, as DDP's buckets want them.
        kernel = self.out.weight.flatten(1)[..., None, None]
        read = functional.silu(self.head(channel_norm(grid)))
        cells = functional.conv2d(read, kernel, self.out.bias)
        return functional.pixel_shuffle(cells, self.patch_size)

    def actions(self, conditioning: Conditioning) -> Tensor:
        """The embedded actions `[B, L, width]`.

        Raises:
            RecipeError: the conditioner gives no modulation, the only input for actions.
        """
        if conditioning.modulation is None:
            raise RecipeError(
                "a recurrent model takes actions as a modulation, which this conditioner does not "
                "give: set conditioner=adaln"
            )
        return conditioning.modulation


class _RecurrentStream(LatentStream):
    """A stream that carries the state of a recurrent model."""

    def __init__(self, model: RecurrentModel, given: Latent, draw: tuple[Tensor, ...]) -> None:
        self._model = model
        self._given = given
        self._draw = draw
        self._state: tuple[Tensor, ...] | None = None

    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame; see `LatentStream.advance`."""
        if self._state is None:
            self._state = self._model.initial_state(self._given, conditioning, *self._draw)
        latent, self._state = self._model.next_state(self._state, conditioning)
        return latent


def _picked(frames: list[Tensor], only: Tensor | None) -> Tensor:
    """Values of the frames, each `[B, …]`, side by side; with `only`, of those `[B, N]`."""
    stacked = torch.stack(frames, 1)
    if only is None:
        return stacked
    return stacked[torch.arange(len(only), device=only.device)[:, None], only]


def _tensors(state: State) -> tuple[Tensor, ...]:
    return (*state[:3], *state.draw, *state.agent)


def _coordinates(cells: Tensor) -> Tensor:
    """Row and column of each cell, scaled to [−1, 1]: `[B, 2, h, w]`."""
    rows, columns = (torch.linspace(-1, 1, n, device=cells.device) for n in cells.shape[-2:])
    grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij"))
    return grid.to(cells.dtype).expand(len(cells), -1, -1, -1)
