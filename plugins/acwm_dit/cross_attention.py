"""Conditioning through cross-attention."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.shapes import Actions, Tokens
from acwm_dit.actions import Embedding, action_embedder
from acwm_dit.attention import attend
from acwm_dit.linear import Linear


class CrossAttention(Conditioner):
    """Lets the tokens of each latent frame attend to that frame's action token, after every layer.

    Each layer's contribution goes through a tanh gate that starts at zero, so an untrained model
    ignores its actions until the gates open. As in the published model, there is one action token
    per frame. Attention over one token has weight 1, so all tokens of a frame get the same vector.

    Args:
        action_size: dimensions A of an action.
        temporal_stride: actions per latent frame.
        width: model width D, also that of the action tokens.
        layers: layers of the model; one cross-attention layer follows each of them.
        heads: attention heads.
        widths: width of the tokens after each layer; `width` for all by default.
        embedding: ``"stacked"``, or the published ``"convolutional"``.

    Raises:
        RecipeError: the heads do not divide one of the widths.
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
        each = (width,) * layers if widths is None else widths
        self.attentions = nn.ModuleList(GatedAttention(size, heads, width) for size in each)

    def forward(self, actions: Actions) -> Conditioning:
        """Embed actions `[B, T, A]` as a context of one token per latent frame, `[B, L, 1, D]`."""
        context = self.embedder(actions).unsqueeze(2)
        return Conditioning(modulation=None, context=context, conditioner=self)

    def inject(self, layer: int, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Add what the tokens read from their frame's actions."""
        assert conditioning.context is not None
        return self.attentions[layer](tokens, conditioning.context)


class GatedAttention(nn.Module):
    """Tanh-gated attention from tokens to a context, frame by frame.

    The gate follows Flamingo (Alayrac et al. 2022, arXiv 2204.14198).

    Args:
        width: width of the tokens.
        heads: attention heads; must divide the width.
        context_width: width of the context tokens.

    Raises:
        RecipeError: the heads do not divide the width.
    """

    def __init__(self, width: int, heads: int, context_width: int) -> None:
        super().__init__()
        if width % heads:
            raise RecipeError(
                f"cross_attention cannot divide the {width} channels of a layer among {heads} heads"
            )
        self.heads = heads
        self.norm_tokens = nn.LayerNorm(width)
        self.norm_context = nn.LayerNorm(context_width)
        self.query = Linear(width, width, bias=False)
        self.key_value = Linear(context_width, 2 * width, bias=False)
        self.out = Linear(width, width)
        self.gate = nn.Parameter(torch.zeros(1))

    def forward(self, tokens: Tokens, context: Tensor) -> Tokens:
        """Let tokens attend to the K context tokens of their frame.

        Args:
            tokens: `[B, L, N, width]`.
            context: `[B, L, K, context_width]`.
        """
        query = self.query(self.norm_tokens(tokens)).unflatten(-1, (self.heads, -1))
        key_value = self.key_value(self.norm_context(context)).unflatten(-1, (2, self.heads, -1))
        projected = (query, *key_value.unbind(-3))
        q, k, v = (part.flatten(0, 1).transpose(1, 2) for part in projected)
        attended = attend(q, k, v).transpose(1, 2).reshape(tokens.shape)
        return torch.addcmul(tokens, torch.tanh(self.gate), self.out(attended))
