"""A model without training that follows actions: it draws a white disc where they point.

It predicts push_cube: the first frame stays, and each frame shows the disc at the place that the
action before it asked the pusher to go to.
"""

from dataclasses import replace

import torch
from torch import nn

from acwm_core.data.card import DatasetCard
from acwm_core.env.environment import resolve_size
from acwm_core.model.dynamics import Keypoints, LatentStream, Predictor
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from tests import tiny
from tests.plugins import plugin_of

SIDE, STRIDE = 64, 4

REACH = 0.388
"""Of an action of 1 in the picture: 0.26 m, seen from 1.25 m under an angle of 30°."""

RADIUS = 4


class Follower(Predictor):
    width, layers, heads = 2 * STRIDE, 0, 1
    causal = True

    def __init__(self, *, latent_channels: int):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, given, conditioning, frames, generators=()):
        stream = _FollowerStream(given)
        more = [stream.advance(conditioning.frames(k - 1, k + 1)) for k in range(1, frames)]
        return torch.cat(more, 1)

    def stream(self, given, *, context, generators=()):
        return _FollowerStream(given)


class _FollowerStream(LatentStream):
    def __init__(self, given):
        self._base = nn.functional.pixel_shuffle(given[:, -1], 8)  # [B, 4 · 3, H, W]
        self._place = torch.zeros(2)  # of a thing that can be moved and is not drawn

    def keypoints(self):
        number = len(self._base)
        return Keypoints(self._place.expand(number, 1, 1, 2), torch.ones(1, 2), torch.ones(1))

    def move_keypoint(self, number, place):
        self._place = place

    def advance(self, conditioning):
        frames = self._base.unflatten(1, (STRIDE, 3)).clone()
        rows, columns = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
        for k, (x, y) in enumerate(conditioning.modulation[0, -1].view(STRIDE, 2).tolist()):
            across, down = SIDE * (0.5 + REACH * x), SIDE * (0.5 - REACH * y)
            near = (columns + 0.5 - across) ** 2 + (rows + 0.5 - down) ** 2 < RADIUS**2
            frames[:, k, :, near] = 2.0  # (1 − 0.5) / 0.25: white
        return nn.functional.pixel_unshuffle(frames.flatten(1, 2), 8)[:, None]


def disturb(world):
    """Give a fresh model weights that make it change what it sees, and heed actions."""
    torch.manual_seed(0)
    with torch.no_grad():
        for part, amount in ((world.model, 0.1), (world.conditioner, 0.5)):
            for each in part.parameters():
                each.add_(amount * torch.randn_like(each))


def register():
    tiny.register()
    if "follower" not in catalog().plugins:
        catalog().add_plugin(plugin_of(models={"follower": f"{__name__}:Follower"}), "follower")


def make_run(folder, environment="push_cube", model=None, conditioner="raw", objective=None):
    """A run folder with the follower or a fresh model, as training would leave it."""
    register()
    card = catalog().component("environment", environment).load().card
    size = resolve_size(SIDE, card.frame_size)
    recipe = Recipe.from_dict(
        {
            "env": {"name": environment},
            "codec": {"name": "identity"},
            "model": model or {"name": "follower"},
            "conditioner": {"name": conditioner},
            "objective": {"name": objective or "regression"},
            "data": {"path": "data/none", "clip_frames": 9},
            "evaluation": tiny.METRICS,
        }
    )
    card = replace(card, frame_size=size)
    data = DatasetCard(card, {"train": 1}, 0, {"size": list(size)}, {}, 1, {})
    return tiny.save_run(folder, recipe, data, change=disturb if model else lambda _: None)
