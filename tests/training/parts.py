"""Recipes of every model, conditioner and objective that is installed, in small."""

import functools
import itertools
from inspect import signature

import pytest
import torch

from acwm_core.errors import RecipeError
from acwm_core.model.build import build_world_model
from acwm_core.recipe import Recipe
from tests.checks.results import installed
from tests.tiny import TinyWorld

SMALL = {"width": 16, "layers": 1, "heads": 2, "channels": 8, "blocks": 1, "patch_size": 1}

FULLER = {"next_frame": {"own_past": 0.5}, "shortcut": {"bootstrapped": 0.5, "finest": 4}}
"""Parameters with which an objective does all that it can."""


def recipe(data, model, conditioner, objective, training=None, trainer=None):
    """A recipe of these, for the tiny world; it trains for 6 steps and then validates."""
    small = {name: SMALL[name] for name in signature(model.load()).parameters if name in SMALL}
    often = {"validate_every_n_steps": 6, "checkpoint_every_n_steps": 6}
    often |= {"sample_every_n_steps": 6, "sample_videos": 1, "validation_rollouts": 1}
    clips = {"clip_frames": 9, "window_stride": 2, "validation_episodes": 2, "batch_size": 2}
    flags = {"max_steps": 6, "precision": "32-true", "log_every_n_steps": 3}
    return Recipe.from_dict(
        {
            "codec": {"name": "identity", "spatial_stride": 4, "temporal_stride": 2},
            "model": {"name": model.name, **small},
            "conditioner": {"name": conditioner},
            "objective": {"name": objective, **FULLER.get(objective, {})},
            "data": {"path": str(data), **clips},
            "training": {**often, **(training or {})},
            "trainer": {**flags, "gradient_clip_val": 1.0, **(trainer or {})},
        }
    )


@functools.cache
def combinations():
    """Test parameters: those that fit together and hold something that none before them did."""
    models = {part.target: part for part in installed("model")}.values()
    names = [[part.name for part in installed(kind)] for kind in ("conditioner", "objective")]
    seen, found = set(), []
    for model, *others in itertools.product(models, *names):
        new = {(model.name, other) for other in others} - seen
        if new:
            try:
                world = build_world_model(recipe("", model, *others), TinyWorld.card)
                world.loss(torch.zeros(1, 3, world.codec.channels, 4, 4), torch.zeros(1, 5, 2))
            except RecipeError:
                continue
            seen |= new
            found.append(pytest.param((model, *others), id="-".join([model.name, *others])))
    return found
