"""The `Conditioner` interface: how actions enter a dynamics model.

A conditioner owns its parameters, including any layers it adds between the model's own, so that
the same model works with every conditioner.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn

from acwm_core.errors import PluginError, check_shape
from acwm_core.model.shapes import Actions, Modulation, Tokens


@dataclass(frozen=True)
class Conditioning:
    """Embedded actions, computed once per clip and used at every sampling step and layer.

    Attributes:
        modulation: `[B, L, D]`, added to the timestep embedding of each latent frame (AdaLN), or
            None.
        context: `[B, L, K, D]`, K tokens per latent frame for what the conditioner does at the
            input and after layers, or None.
        conditioner: the conditioner that made this and whose layers apply it.
    """

    modulation: Modulation | None
    context: Tensor | None
    conditioner: Conditioner

    def inject_input(self, tokens: Tokens) -> Tokens:
        """Let the conditioner change the tokens `[B, L, N, D]` before the model's first layer."""
        return self.conditioner.inject_input(tokens, self)

    def inject(self, layer: int, tokens: Tokens) -> Tokens:
        """Pass tokens through the conditioner's layers after model layer `layer`.

        Args:
            layer: from 0.
            tokens: `[B, L, N, D]`, where D is the model's `widths[layer]`.
        """
        return self.conditioner.inject(layer, tokens, self)

    def frames(self, start: int, stop: int) -> Conditioning:
        """The conditioning of latent frames `start` to `stop` only."""
        modulation, context = (
            None if part is None else part[:, start:stop]
            for part in (self.modulation, self.context)
        )
        return Conditioning(modulation, context, self.conditioner)


class Conditioner(nn.Module, ABC):
    """Embeds actions for a dynamics model. It is built to fit the model, codec and environment.

    Every conditioner takes these keyword arguments, which the framework fills in. Its own
    parameters come after them and are set in the recipe.

    Args:
        action_size: number A of action dimensions.
        temporal_stride: actions per latent frame, from the codec.
        width: width D of modulation, context and the tokens at the input.
        layers: number of layers of the model.
        heads: number of attention heads of the model.
        widths: width of the tokens after each layer, as `tuple[int, ...]`; given only if they
            differ from `width`, so a conditioner that does not take it fits all other models.

    Attributes:
        history: number of latent steps of actions, up to and including its own, on which the entry
            of a latent frame depends; it may also look one step ahead. None means all steps since
            the start, which rules out streaming.
    """

    history: int | None = None

    @abstractmethod
    def forward(self, actions: Actions) -> Conditioning:
        """Embed actions `[B, T, A]`, normalised to [-1, 1], with T = 1 + (L − 1) · stride.

        Row i leads from frame i to frame i + 1. Entry l of the result depends on no action later
        than the last frame of latent frame l, whatever the model's attention in time. A conditioner
        that looks further ahead must say so; streaming it would need that delay.
        """

    def condition(self, actions: Actions, frames: int, width: int) -> Conditioning:
        """Call `forward`, and check its result for `frames` latent frames and model width `width`.

        Raises:
            PluginError: the result has the wrong type or shape.
        """
        conditioning: object = self(actions)
        if not isinstance(conditioning, Conditioning):
            raise PluginError(
                f"{type(self).__name__}.forward gives {conditioning!r:.40}, no Conditioning"
            )
        if conditioning.modulation is not None:
            check_shape(self, "modulation", conditioning.modulation, len(actions), frames, width)
        if conditioning.context is not None:
            check_shape(self, "context", conditioning.context, len(actions), frames, -1, width)
        return conditioning

    def inject_input(self, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Change the tokens `[B, L, N, D]` before the first layer; unchanged by default."""
        return tokens

    def inject(self, layer: int, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Change the tokens after model layer `layer`; unchanged by default.

        Args:
            layer: from 0.
            tokens: `[B, L, N, D]`, where D is the model's `widths[layer]`.
            conditioning: what `forward` returned.

        Returns:
            Tokens of the same shape.
        """
        return tokens
