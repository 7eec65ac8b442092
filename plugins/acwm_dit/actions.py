"""Embeds actions, of which there is one per video frame, as one vector per latent frame."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.shapes import Actions, Modulation
from acwm_dit.linear import Linear

Embedding = Literal["stacked", "convolutional"]
"""How the actions of a latent step become one vector."""


def action_embedder(
    embedding: Embedding, action_size: int, temporal_stride: int, width: int
) -> ActionEmbedder:
    """Create the embedder with this name.

    Raises:
        RecipeError: the embedding is unknown, or does not support this stride.
    """
    kinds = {"stacked": StackedActions, "convolutional": ConvolutionalActions}
    if embedding not in kinds:
        raise RecipeError(f"unknown action embedding {embedding!r}; known: {', '.join(kinds)}.")
    return kinds[embedding](action_size, temporal_stride, width)


class ActionEmbedder(nn.Module):
    """Base of the embedders: maps actions `[B, 1 + (L − 1)·stride, A]` to `[B, L, D]`.

    Args:
        action_size: dimensions A of an action.
        temporal_stride: actions per latent frame.
        width: size D of the vectors.
    """

    def __init__(self, action_size: int, temporal_stride: int, width: int) -> None:
        super().__init__()
        self.action_size = action_size
        self.temporal_stride = temporal_stride
        self.width = width

    def forward(self, actions: Actions) -> Modulation:
        """Embed the actions.

        Raises:
            ShapeError: the action size is wrong, or the length does not end with a latent frame.
        """
        shape, stride = list(actions.shape), self.temporal_stride
        if actions.ndim != 3 or shape[2] != self.action_size:
            raise ShapeError(f"actions must be [B, T, {self.action_size}], not {shape}")
        if shape[1] < 1 or (shape[1] - 1) % stride:
            raise ShapeError(f"actions must have 1 + k·{stride} rows, not {shape[1]}")
        return self._embed(actions)

    def _embed(self, actions: Actions) -> Modulation:
        raise NotImplementedError


class StackedActions(ActionEmbedder):
    """Concatenates the actions that lead to a latent frame, and embeds them with an MLP.

    Latent frame l > 0 gets the actions (l − 1)·stride … l·stride − 1: those that lead from the last
    video frame of the previous latent frame to its own last video frame, and none after that. No
    action leads to frame 0, which gets a learned vector.
    """

    def __init__(self, action_size: int, temporal_stride: int, width: int) -> None:
        super().__init__(action_size, temporal_stride, width)
        self.first = nn.Parameter(torch.zeros(width))
        self.mlp = _mlp(action_size * temporal_stride, width)

    def _embed(self, actions: Actions) -> Modulation:
        steps = actions[:, :-1].unflatten(1, (-1, self.temporal_stride)).flatten(2)
        embedded = self.mlp(steps)
        first = self.first.to(embedded.dtype).expand(len(actions), 1, -1)
        return torch.cat([first, embedded], 1)


class ConvolutionalActions(ActionEmbedder):
    """The published embedder: an MLP per action, then convolutions of stride 2 over time.

    At stride 4, vector l sees the actions 4l − 3 … 4l + 3. Three of them act after the end of
    latent frame l. Action 4l − 4, the first that leads to frame l, is missing: vector l − 1 has it.

    Raises:
        RecipeError: the temporal stride is not a power of two.
    """

    def __init__(self, action_size: int, temporal_stride: int, width: int) -> None:
        super().__init__(action_size, temporal_stride, width)
        halvings = temporal_stride.bit_length() - 1
        if temporal_stride != 2**halvings:
            raise RecipeError(
                "the convolutional action embedding needs a temporal stride that is a power of "
                f"two, not {temporal_stride}; use embedding=stacked"
            )
        self.mlp = _mlp(action_size, width)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(width, width, kernel_size=3, stride=2, padding=1) for _ in range(halvings)
        )
        self.out = Linear(width, width)

    def _embed(self, actions: Actions) -> Modulation:
        features: Tensor = self.mlp(actions).transpose(1, 2)
        for index, convolution in enumerate(self.convolutions):
            features = convolution(nn.functional.silu(features) if index else features)
        return self.out(nn.functional.silu(features.transpose(1, 2)))


def _mlp(size: int, width: int) -> nn.Sequential:
    return nn.Sequential(Linear(size, width), nn.SiLU(), Linear(width, width))
