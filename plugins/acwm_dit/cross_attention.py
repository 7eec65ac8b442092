"""Conditioning through cross-attention."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from acwm_core.conditioner import Conditioner, Conditioning
from acwm_core.shapes import Actions, Tokens
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
        width: model width D.
        layers: layers of the model; one cross-attention layer follows each of them.
        heads: attention heads.
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
        embedding: Embedding = "stacked",
    ) -> None:
        super().__init__()
        self.embedder = action_embedder(embedding, action_size, temporal_stride, width)
        self.attentions = nn.ModuleList(GatedAttention(width, heads) for _ in range(layers))

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
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_tokens = nn.LayerNorm(width)
        self.norm_context = nn.LayerNorm(width)
        self.query = Linear(width, width, bias=False)
        self.key_value = Linear(width, 2 * width, bias=False)
        self.out = Linear(width, width)
        self.gate = nn.Parameter(torch.zeros(1))

    def forward(self, tokens: Tokens, context: Tensor) -> Tokens:
        """Tokens `[B, L, N, D]` attend to the K context tokens `[B, L, K, D]` of their frame."""
        query = self.query(self.norm_tokens(tokens)).unflatten(-1, (self.heads, -1))
        key_value = self.key_value(self.norm_context(context)).unflatten(-1, (2, self.heads, -1))
        projected = (query, *key_value.unbind(-3))
        q, k, v = (part.flatten(0, 1).transpose(1, 2) for part in projected)
        attended = attend(q, k, v).transpose(1, 2).reshape(tokens.shape)
        return torch.addcmul(tokens, torch.tanh(self.gate), self.out(attended))
