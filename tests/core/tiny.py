"""The smallest real parts: a codec, a model and conditioners that run in microseconds."""

import torch
from torch import nn

from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Denoiser
from acwm_core.model.objectives.full_sequence import FullSequence
from acwm_core.model.world_model import WorldModel


class MeanCodec(Codec):
    """Latents are colours of 8×8 blocks in the last frame of each group of four, scaled to ±1."""

    channels = 3
    spatial_stride = 8
    temporal_stride = 4

    def _encode(self, video):
        return (
            nn.functional.avg_pool3d(video[:, ::4].transpose(1, 2), (1, 8, 8)).transpose(1, 2) * 2
            - 1
        )

    def _decode(self, latents):
        video = latents.repeat_interleave(8, 3).repeat_interleave(8, 4) / 2 + 0.5
        return torch.cat([video[:, :1], video[:, 1:].repeat_interleave(4, 1)], dim=1)

    def fingerprint(self):
        return "mean"


class PointwiseModel(Denoiser):
    """One linear layer per latent pixel, with conditioning added in between."""

    def __init__(self, *, latent_channels, width=8):
        super().__init__()
        self.width, self.layers, self.heads = width, 1, 1
        self.embed = nn.Linear(latent_channels + 1, width)
        self.out = nn.Linear(width, latent_channels)

    def forward(self, latents, sigma, conditioning):
        x = latents.flatten(3).transpose(2, 3)
        level = sigma[:, :, None, None].expand(-1, -1, x.shape[2], 1)
        x = torch.tanh(self.embed(torch.cat([x, level], dim=3)))
        if conditioning.modulation is not None:
            x = x + conditioning.modulation[:, :, None]
        x = conditioning.inject(0, conditioning.inject_input(x))
        return self.out(x).transpose(2, 3).reshape(latents.shape)


class SumConditioner(Conditioner):
    """Adds a linear map of the sum of the actions so far."""

    def __init__(self, *, action_size, temporal_stride, width, layers, heads):
        super().__init__()
        self.stride = temporal_stride
        self.embed = nn.Linear(action_size, width)

    def forward(self, actions):
        so_far = actions.cumsum(1) - actions
        return Conditioning(self.embed(so_far[:, :: self.stride]), None, self)


def tiny_world_model(seed=0, actions=2, objective=FullSequence, **flow):
    torch.manual_seed(seed)
    codec = MeanCodec()
    model = PointwiseModel(latent_channels=codec.channels)
    conditioner = SumConditioner(
        action_size=actions, temporal_stride=4, width=model.width, layers=1, heads=1
    )
    bounds = [-2.0] * actions, [2.0] * actions
    return WorldModel(codec, model, conditioner, objective(**{"steps": 3, **flow}), *bounds)
