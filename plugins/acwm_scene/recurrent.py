"""A deterministic recurrent predictor of the next latent frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.model.shapes import Latent
from acwm_scene.layers import FilmBlock, MatrixConv, channel_norm

START_CELLS, STEP_CELLS = 4, 2
"""Cells per side that the grid is pooled to: for the initial vector, and at every step."""


class State(NamedTuple):
    """The state that is passed from one latent frame to the next.

    Attributes:
        grid: features of each place, `[B, channels, h, w]`.
        vector: features of the whole scene, `[B, width]`.
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
    """

    grid: Tensor
    vector: Tensor
    base: Tensor


class RecurrentModel(Predictor):
    """Unrolls a state from the given latent frame, one step per latent frame.

    The state has two parts. The grid has a cell for each cell of the latent; the coordinates of the
    cells are among its inputs. The vector is updated by a GRU from the embedded actions and the
    pooled grid. Residual convolution blocks, modulated by the vector, update the grid. A predicted
    frame is the given frame plus what a last convolution reads from the grid.

    With several given frames it starts from the last one and from the change just before it, which
    shows velocities.

    Args:
        latent_channels: channels C of the codec.
        channels: channels of the grid.
        width: size of the vector and of the conditioner's modulation.
        blocks: number of residual blocks per step.

    Raises:
        RecipeError: a size below 1.
    """

    layers, heads = 0, 1
    causal = True

    def __init__(
        self, *, latent_channels: int, channels: int = 64, width: int = 192, blocks: int = 2
    ) -> None:
        super().__init__()
        if min(channels, width, blocks) < 1:
            raise RecipeError("channels, width and blocks of a recurrent model must be at least 1")
        self.latent_channels = latent_channels
        self.width = width
        self.stem = nn.Conv2d(2 * latent_channels + 2, channels, 3, padding=1)
        self.start_vector = nn.Linear(channels * START_CELLS**2, width)
        self.start_block = FilmBlock(channels, width)
        self.read_grid = nn.Linear(channels * STEP_CELLS**2, width)
        self.gru = nn.GRUCell(2 * width, width)
        self.blocks = nn.ModuleList(FilmBlock(channels, width) for _ in range(blocks))
        self.head = MatrixConv(channels, channels)
        self.out = nn.Conv2d(channels, latent_channels, 1)
        for parameter in self.out.parameters():
            nn.init.zeros_(parameter)

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Predict the latent frames after the given ones, `[B, L − K, C, h, w]`."""
        count = frames - given.shape[1]
        numbers = torch.arange(count, device=given.device).expand(len(given), -1)
        return self.predict_frames(given, conditioning, frames, numbers)

    def predict_frames(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        numbers: Tensor,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Unroll all frames, and read only some; see `Predictor.predict_frames`."""
        actions = self.actions(conditioning)
        grids: list[Tensor] = []
        state = self.start(given, actions[:, 0])
        for frame in range(given.shape[1], frames):
            state = self.step(state, actions[:, frame])
            grids.append(state.grid)
        rows = torch.arange(len(numbers), device=numbers.device)[:, None]
        grid = torch.stack(grids, 1)[rows, numbers].flatten(0, 1)
        return state.base[:, None] + self._read(grid).unflatten(0, numbers.shape)

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[Generator] = ()
    ) -> LatentStream:
        """Stream from the state. `context` is ignored, as the state holds all that is known."""
        return _RecurrentStream(self, given)

    def matrices(self) -> list[nn.Parameter]:
        """The weights of the convolutions in the blocks and in the head."""
        return [module.weight for module in self.modules() if isinstance(module, MatrixConv)]

    def start(self, given: Latent, first: Tensor) -> State:
        """The state after the last of the given frames `[B, K, C, h, w]`.

        Args:
            given: latents of the given frames.
            first: the conditioner's output for a frame that no action leads to, `[B, width]`.
        """
        shape = list(given.shape)
        if given.ndim != 5 or shape[2] != self.latent_channels:
            raise ShapeError(
                f"RecurrentModel takes latents [B, L, {self.latent_channels}, h, w], not {shape}"
            )
        base = given[:, -1]
        change = base - given[:, -2] if shape[1] > 1 else torch.zeros_like(base)
        grid = self.stem(torch.cat([base, change, _coordinates(base)], 1))
        grid = grid.contiguous(memory_format=torch.channels_last)
        pooled = functional.adaptive_avg_pool2d(grid, START_CELLS).flatten(1)
        vector = torch.tanh(self.start_vector(pooled) + first)
        return State(self.start_block(grid, vector), vector, base)

    def step(self, state: State, action: Tensor) -> State:
        """The state one latent frame later.

        Args:
            state: state of the previous frame.
            action: the embedded actions that lead to the next frame, `[B, width]`.
        """
        pooled = functional.adaptive_avg_pool2d(state.grid, STEP_CELLS).flatten(1)
        vector = self.gru(torch.cat([action, self.read_grid(pooled)], -1), state.vector)
        grid = state.grid
        for block in self.blocks:
            grid = block(grid, vector + action)
        return State(grid, vector, state.base)

    def initial_state(self, given: Latent, conditioning: Conditioning) -> tuple[Tensor, ...]:
        """The first state of a stream that begins with latents `[B, K, C, h, w]`, as tensors.

        `conditioning` starts at the first latent frame, and may be longer.
        """
        return tuple(self.start(given, self.actions(conditioning)[:, 0]))

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent frame `[B, 1, C, h, w]` and its state, given the last conditioning."""
        moved = self.step(State(*state), self.actions(conditioning)[:, -1])
        frame = moved.base + self._read(moved.grid).to(moved.base)
        return frame[:, None], tuple(moved)

    def _read(self, grid: Tensor) -> Tensor:
        grid = grid.contiguous(memory_format=torch.channels_last)
        # As a matrix, a 1×1 kernel has gradients of its own strides, as DDP's buckets want them.
        kernel = self.out.weight.flatten(1)[..., None, None]
        read = functional.silu(self.head(channel_norm(grid)))
        return functional.conv2d(read, kernel, self.out.bias)

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

    def __init__(self, model: RecurrentModel, given: Latent) -> None:
        self._model = model
        self._given = given
        self._state: tuple[Tensor, ...] | None = None

    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame; see `LatentStream.advance`."""
        if self._state is None:
            self._state = self._model.initial_state(self._given, conditioning)
        latent, self._state = self._model.next_state(self._state, conditioning)
        return latent


def _coordinates(cells: Tensor) -> Tensor:
    """Row and column of each cell, scaled to [−1, 1]: `[B, 2, h, w]`."""
    rows, columns = (torch.linspace(-1, 1, n, device=cells.device) for n in cells.shape[-2:])
    grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij"))
    return grid.to(cells.dtype).expand(len(cells), -1, -1, -1)
