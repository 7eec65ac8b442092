"""A model of the sliding square that knows its world exactly, and one that ignores actions."""

from dataclasses import replace

import torch
from torch import nn

from acwm_core.data.card import DatasetCard
from acwm_core.model.build import build_world_model
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.plugins import catalog, hookimpl
from acwm_core.recipe import Recipe
from acwm_core.training.run import save_weights
from tests.evaluation.tiny import METRICS, SIDE
from tests.planning import tiny
from tests.plugins import plugin_of

STRIDE, FRAME = 4, 32
GROUND, RED = 30 / 255, 200 / 255
MOST = 2.0
"""Pixels of an action of 1."""


def squares(corners):
    """Frames `[N, 3, 32, 32]` of squares whose corners are at these rows and columns `[N, 2]`."""
    frames = torch.full((len(corners), 3, FRAME, FRAME), GROUND)
    for frame, (row, column) in zip(frames, corners.round().int().tolist(), strict=True):
        frame[0, row : row + SIDE, column : column + SIDE] = RED
    return frames


def corners_of(frames):
    """Where the brightest squares begin, `[N, 2]`."""
    sums = nn.functional.avg_pool2d(frames[:, :1], SIDE, 1)[:, 0]
    best = sums.flatten(1).argmax(1)
    return torch.stack([best // sums.shape[2], best % sums.shape[2]], 1).float()


class Exact(Predictor):
    """Slides the square as the simulator does, from where it is seen, to half a pixel."""

    width, layers, heads = 2 * STRIDE, 0, 1
    causal = streams = True
    blind = False

    def __init__(self, *, latent_channels: int):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, given, conditioning, frames):
        stream = ExactStream(given, self.blind)
        more = [stream.advance(conditioning.frames(k - 1, k + 1)) for k in range(1, frames)]
        return torch.cat(more, 1)

    def stream(self, given, *, context):
        return ExactStream(given, self.blind)


class Blind(Exact):
    """Lets the square drift to a corner whatever is done."""

    blind = True


class ExactStream(LatentStream):
    def __init__(self, given, blind):
        shown = nn.functional.pixel_shuffle(given[:, -1], 8).unflatten(1, (STRIDE, 3))[:, -1]
        self._corners, self._blind = corners_of(shown), blind

    def advance(self, conditioning):
        actions = conditioning.modulation[:, -1].unflatten(1, (STRIDE, 2))
        made = []
        for action in actions.unbind(1):
            moved = torch.ones_like(action) if self._blind else MOST * action
            self._corners = (self._corners + moved).clamp(0, FRAME - SIDE)
            made.append((squares(self._corners) - 0.5) / 0.25)
        return nn.functional.pixel_unshuffle(torch.cat(made, 1), 8)[:, None]


class Unread(tiny.Slide):
    """The world without an estimator."""

    card = replace(tiny.Slide.card, name="unread")


class UnreadPlugin:
    @staticmethod
    @hookimpl
    def register_environments(registry):
        registry.add("unread", f"{__name__}:Unread", tasks={"place": "tests.planning.tiny:PLACE"})


class Raw(Conditioner):
    """The normalised actions of a latent frame in a row."""

    history = 1

    def __init__(self, *, action_size, temporal_stride, width, layers, heads):
        super().__init__()

    def forward(self, actions):
        first = actions.new_zeros(len(actions), 1, 2 * STRIDE)
        rows = actions[:, :-1].unflatten(1, (-1, STRIDE)).flatten(2)
        return Conditioning(torch.cat([first, rows], 1), None, self)


def register():
    tiny.register()
    if "slide" not in catalog().plugins:
        models = {"exact": f"{__name__}:Exact", "blind": f"{__name__}:Blind"}
        conditioners = {"slide_raw": f"{__name__}:Raw"}
        catalog().add_plugin(UnreadPlugin, "unread")
        catalog().add_plugin(plugin_of(models=models, conditioners=conditioners), "slide")


def make_run(folder, model="exact", environment="slide", **data):
    """A run folder with such a model, as training would leave it."""
    register()
    card = catalog().component("environment", environment).load().card
    recipe = Recipe.from_dict(
        {
            "env": {"name": environment},
            "codec": {"name": "identity"},
            "model": {"name": model},
            "conditioner": {"name": "slide_raw"},
            "objective": {"name": "regression"},
            "data": {"path": "data/none", "clip_frames": 13, **data},
            "evaluation": METRICS,
        }
    )
    folder.mkdir(parents=True)
    (folder / "recipe.yaml").write_text(recipe.to_yaml())
    DatasetCard(card, {"train": 1}, 0, {}, {}, 1, {}).write(folder)
    world = build_world_model(recipe, card)
    weights = world.state_dict()
    save_weights(folder / "model.safetensors", weights, world.codec.fingerprint(), step=1)
    return folder
