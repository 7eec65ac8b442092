"""A denoiser whose layers differ in width, and conditioners that act at unusual places."""

import torch
from torch import nn
from torch.nn import functional

from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Denoiser
from tests.plugins import plugin_of
from tests.tiny import SumConditioner


class SmallUNet(Denoiser):
    """Three convolutions; the one in the middle is wider, at half the size, and looks back in time.

    Args:
        latent_channels: channels C of the codec.
        width: channels of the outer layers.
        middle: channels of the layer in the middle.
    """

    layers, heads = 3, 2
    causal = True

    def __init__(self, *, latent_channels: int, width: int = 8, middle: int = 20):
        super().__init__()
        self.width, self.widths = width, (width, middle, width)
        self.enter = nn.Conv2d(latent_channels + 1, width, 3, padding=1)
        self.modulate = nn.ModuleList(nn.Linear(width, size) for size in self.widths)
        self.blocks = nn.ModuleList(
            [
                nn.Conv2d(width, width, 3, padding=1),
                nn.Conv2d(2 * width, middle, 3, padding=1, stride=2),
                nn.Conv2d(middle + width, width, 3, padding=1),
            ]
        )
        self.leave = nn.Conv2d(width, latent_channels, 3, padding=1)

    def forward(self, latents, sigma, conditioning):
        """Evaluate the network; see `Denoiser.forward`. The sides h and w must be even."""
        level = sigma[:, :, None, None, None].expand_as(latents[:, :, :1])
        x = _framewise(self.enter, torch.cat([latents, level], 2))
        x = _acted(conditioning.inject_input, x)
        x = outer = self._layer(0, x, conditioning)
        past = x.cumsum(1) / torch.arange(1, x.shape[1] + 1)[:, None, None, None]
        x = self._layer(1, torch.cat([x, past], 2), conditioning)
        wide = x.repeat_interleave(2, 3).repeat_interleave(2, 4)
        x = self._layer(2, torch.cat([wide, outer], 2), conditioning)
        return _framewise(self.leave, x)

    def _layer(self, layer, x, conditioning):
        x = _framewise(self.blocks[layer], x)
        if conditioning.modulation is not None:
            x = x + self.modulate[layer](conditioning.modulation)[..., None, None]
        return _acted(lambda tokens: conditioning.inject(layer, tokens), functional.silu(x))


def _framewise(layer, x):
    """Apply a layer to every frame of `[B, L, D, h, w]`."""
    return layer(x.flatten(0, 1)).unflatten(0, x.shape[:2])


def _acted(act, x):
    """Let a conditioner act on `[B, L, D, h, w]` as tokens `[B, L, h · w, D]`."""
    return act(x.flatten(3).transpose(2, 3)).transpose(2, 3).reshape(x.shape)


class AtTheInput(Conditioner):
    """Adds the embedded actions to the tokens before the first layer, and does nothing else."""

    history = 1

    def __init__(self, *, action_size, temporal_stride, width, layers, heads, widths=None):
        super().__init__()
        self.stride = temporal_stride
        self.embed = nn.Linear(action_size * temporal_stride, width)

    def forward(self, actions):
        rows = functional.pad(actions[:, :-1], (0, 0, self.stride, 0))
        steps = rows.unflatten(1, (-1, self.stride)).flatten(2)
        return Conditioning(None, self.embed(steps).unsqueeze(2), self)

    def inject_input(self, tokens, conditioning):
        return tokens + conditioning.context


class OneWidth(SumConditioner):
    """Has layers of its own, and knows only the model's width."""

    def __init__(self, **fitted):
        super().__init__(**fitted)
        self.mix = nn.Linear(fitted["width"], fitted["width"])

    def inject(self, layer, tokens, conditioning):
        return tokens + self.mix(tokens)


ToysPlugin = plugin_of(
    models={"toy_unet": "tests.checks.toys:SmallUNet"},
    conditioners={
        "toy_input": "tests.checks.toys:AtTheInput",
        "toy_one_width": "tests.checks.toys:OneWidth",
    },
)
