"""A world of dots that actions move by whole cells, and world models of given latents."""

import torch
from torch.nn import functional

from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog

BOUNDS = [-1.0, -1.0], [1.0, 1.0]


def world_codec(stride=4):
    return catalog().create("codec", "identity", temporal_stride=stride)


def world_of(model, stride=4, *, states=0, objective=None):
    """A world model of `model`, with a conditioner that fits."""
    torch.manual_seed(1)
    conditioner = catalog().create(
        "conditioner",
        "adaln",
        action_size=2,
        temporal_stride=stride,
        width=model.width,
        layers=model.layers,
        heads=model.heads,
    )
    of = objective or Regression()
    return WorldModel(
        world_codec(stride), model, conditioner, of, *BOUNDS, state_shapes={"all": (states,)}
    )


def moving_dots(batch, seed):
    """Latents `[B, 6, 2, 8, 8]` of a dot that actions move by whole cells, and these actions."""
    generator = torch.Generator().manual_seed(seed)
    moves = torch.randint(-1, 2, (batch, 6, 2), generator=generator)
    place = torch.randint(2, 6, (batch, 1, 2), generator=generator)
    places = (place + functional.pad(moves[:, :-1], (0, 0, 1, 0)).cumsum(1)) % 8
    latents = torch.zeros(batch, 6, 2, 8, 8)
    b, t = torch.meshgrid(torch.arange(batch), torch.arange(6), indexing="ij")
    latents[b, t, 0, places[..., 0], places[..., 1]] = 4.0
    return latents, moves.float()
