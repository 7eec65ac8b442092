"""Conditioning through adaptive layer norm."""

from __future__ import annotations

from collections.abc import Sequence

from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.shapes import Actions
from acwm_dit.actions import Embedding, action_embedder


class AdaLN(Conditioner):
    """Adds the action embedding to the timestep embedding of each latent frame.

    Args:
        action_size: dimensions A of an action.
        temporal_stride: actions per latent frame.
        width: model width D.
        layers: layers of the model; not used, as AdaLN adds no layers of its own.
        heads: attention heads of the model; not used.
        widths: widths of layers that differ; not used.
        embedding: ``"stacked"``, or the published ``"convolutional"``.
    """

    history = 1

    def __init__(
        self,
        *,
        action_size: int,
        temporal_stride: int,
        width: int,
        layers: int,
        heads: int,
        widths: Sequence[int] | None = None,
        embedding: Embedding = "stacked",
    ) -> None:
        super().__init__()
        self.embedder = action_embedder(embedding, action_size, temporal_stride, width)

    def forward(self, actions: Actions) -> Conditioning:
        """Embed actions `[B, T, A]` as a modulation `[B, L, D]`."""
        return Conditioning(modulation=self.embedder(actions), context=None, conditioner=self)
