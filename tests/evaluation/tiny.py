"""The smallest real run: a drifting square, a linear model, a dataset of seconds, saved weights."""

import torch
from torch import nn

from acwm_core.checks.trial import shaken
from acwm_core.data.card import DatasetCard
from acwm_core.data.generate import generate
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import Factor
from acwm_core.model.build import build_world_model
from acwm_core.model.codec import Codec
from acwm_core.model.dynamics import Denoiser
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import read_recipe, recipe_folder
from acwm_core.training.run import save_weights
from tests.plugins import plugin_of

SIDE = 8

METRICS = read_recipe(recipe_folder() / "base.yaml")["evaluation"]
"""Those of every shipped recipe."""

SWEEP = {"steps_sweep": [1, 2, 6], "sweep_episodes": 3}
"""A short curve of scores against sampling steps."""


class Drift(Environment):
    """A square that drifts by its action on a plain background."""

    card = EnvironmentCard(
        name="drift",
        summary="a square that drifts by its action",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-2.0, -2.0), (2.0, 2.0), "delta"),
        frame_size=(32, 32),
        fps=10,
        horizon=13,
        factors=(
            Factor.discrete("colour", "grey value", train=(200, 220), ood=(90,), nominal=200),
            Factor.discrete("ground", "grey value", train=(30,), ood=(60,), nominal=30),
        ),
        ood_shifts=("colour", "ground"),
        state=(StateField("position", (2,), "px", "of the square's corner"),),
        instances=("background", "square"),
        engine="numpy",
        episodes={"train": 8, "ind_test": 4, "ood_test": 4},
    )

    def _start(self, factors, rng):
        self._factor_values = dict(factors)
        self._position = rng.uniform(0, 32 - SIDE, 2)

    def _advance(self, action):
        self._position = (self._position + action).clip(0, 32 - SIDE)

    def _render(self):
        import numpy as np

        row, column = self._position.round().astype(int)
        frame = np.full((*self.frame_size, 3), self._factor_values["ground"], np.uint8)
        mask = np.zeros(self.frame_size, np.uint8)
        frame[row : row + SIDE, column : column + SIDE, 0] = self._factor_values["colour"]
        mask[row : row + SIDE, column : column + SIDE] = 1
        return frame, mask

    def _state(self):
        return {"position": self._position.copy()}

    def _contacts(self):
        return [(0, 1)]

    def policy(self, rng):
        heading = rng.uniform(-2, 2, 2)
        return lambda: heading


class BlockCodec(Codec):
    """Latents are colours of 4×4 blocks, of one frame in two."""

    channels = 3
    spatial_stride = 4
    temporal_stride = 2

    def _encode(self, video):
        return nn.functional.avg_pool3d(video, (1, 4, 4))[:, ::2] * 2 - 1

    def _decode(self, latents):
        video = (latents + 1) / 2
        video = video.repeat_interleave(4, -1).repeat_interleave(4, -2)
        return video.repeat_interleave(2, 1)[:, 1:]

    def fingerprint(self):
        return "blocks"


class LinearModel(Denoiser):
    """One linear layer per latent pixel, moved by the conditioning."""

    layers = heads = 1

    def __init__(self, *, latent_channels: int, width: int = 4):
        super().__init__()
        self.width = width
        self.enter = nn.Linear(latent_channels + 1, width)
        self.leave = nn.Linear(width, latent_channels)

    def forward(self, latents, sigma, conditioning):
        level = sigma[:, :, None, None, None].expand_as(latents[:, :, :1])
        tokens = self.enter(torch.cat([latents, level], 2).permute(0, 1, 3, 4, 2))
        tokens = torch.tanh(tokens + conditioning.modulation[:, :, None, None])
        return self.leave(tokens).permute(0, 1, 4, 2, 3)


TinyPlugin = plugin_of(
    environments={"drift": f"{__name__}:Drift"},
    codecs={"blocks": f"{__name__}:BlockCodec"},
    models={"linear": f"{__name__}:LinearModel"},
    conditioners={"linear": "tests.core.tiny:SumConditioner"},
)


def register():
    if "tiny_evaluation" not in catalog().plugins:
        catalog().add_plugin(TinyPlugin, "tiny_evaluation")


def make_dataset(path, **episodes):
    counts = {"train": 2, "ind_test": 5, "ood_test": 4, **episodes}
    generate("drift", path, episodes=counts, workers=0, progress=False, shard_episodes=3)
    return path


def make_run(path, data, seed=0, parts=None, **evaluation):
    """A run folder with random weights, as training would leave it; `parts` replace its own."""
    recipe = Recipe.from_dict(
        {
            "env": {"name": "drift"},
            "codec": {"name": "blocks"},
            "model": {"name": "linear"},
            "conditioner": {"name": "linear"},
            "objective": {"steps": 2, "prediction": "clean"},
            "data": {"path": str(data), "clip_frames": 9},
            "evaluation": {**METRICS, "frames": 9, "device": "cpu", "steps_sweep": []} | evaluation,
            **(parts or {}),
        }
    )
    path.mkdir(parents=True)
    (path / "recipe.yaml").write_text(recipe.to_yaml())
    card = DatasetCard.read(data)
    card.write(path)
    torch.manual_seed(seed)
    world_model = build_world_model(recipe, card.environment)
    if parts:
        shaken(world_model.model)  # a fresh network may start at zero
    save_weights(
        path / "model.safetensors",
        world_model.state_dict(),
        world_model.codec.fingerprint(),
        step=7,
    )
    rows = ["step,train/loss,val/loss", *(f"{i},{1 / (i + 1)}," for i in range(0, 60, 10))]
    (path / "metrics.csv").write_text("\n".join([*rows, "60,,0.02", ""]))
    return path
