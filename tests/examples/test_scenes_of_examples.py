"""Worlds of the example packages: their cards alone tell a scene what to learn and predict."""

import math
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.model.build import build_world_model
from acwm_core.recipe import compose
from acwm_scene.declared import default_states
from tests.scene.dots import follow, learn_motion

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES, EPISODES = 21, 48
SMALL = ("codec=compact_reference", "model.channels=24", "model.width=48", "model.blocks=1")


def environment_of(package, name, needs, monkeypatch):
    """An environment of an example; a test is skipped without the simulator or OpenGL."""
    pytest.importorskip(needs, reason=f"{package} needs {needs}")
    monkeypatch.syspath_prepend(EXAMPLES / package)
    environment = getattr(import_module(f"{package}.{name[0]}"), name[1])(size=64)
    try:
        environment.reset(seed=0)
    except (ImportError, AttributeError, RuntimeError) as error:
        pytest.skip(f"{package} cannot draw: {error}")
    return environment


def clips_of(environment, split, episodes):
    """Actions `[N, T, A]`, and states by name, of simulated episodes."""
    specs = [EpisodeSpec(environment.card.name, split, number) for number in range(episodes)]
    clips = [simulate(environment, spec, frames=FRAMES) for spec in specs]
    states = {
        field: torch.from_numpy(np.stack([clip.states[field] for clip in clips])).float()
        for field in clips[0].states
    }
    return torch.from_numpy(np.stack([clip.actions for clip in clips])), states


def side_by_side(fields, names):
    """The numbers of some fields, `[N, T, S]`."""
    return torch.cat(
        [
            fields[name].flatten(2) if fields[name].ndim > 2 else fields[name][..., None]
            for name in names
        ],
        -1,
    )


def change(field, values, others):
    """Mean distance of each number of a field `[N, T, …]`; of angles, the shorter way round."""
    gap = values - others
    if field.kind == "angle":
        gap = (gap + math.pi) % (2 * math.pi) - math.pi
    return gap.abs().flatten(0, 1).mean(0)


def share(errors, changes):
    """Errors relative to the changes of those numbers that change at all."""
    moving = changes > 0.01 * changes.max()
    return (errors[moving].mean() / changes[moving].mean()).item()


@pytest.mark.ci
@pytest.mark.parametrize(
    ("package", "name", "needs", "moved"),
    [
        ("acwm_pendulum", ("pendulum", "Pendulum"), "numpy", ("angle", "velocity")),
        ("acwm_dmc", ("cartpole", "CartPole"), "dm_control", ("cart", "angle", "velocity")),
        ("acwm_pusht", ("pusht", "PushT"), "gym_pusht", ("agent",)),
    ],
)
def test_a_scene_learns_a_world_from_its_card(package, name, needs, moved, monkeypatch):
    """After a hundred steps it predicts where held-out actions lead."""
    environment = environment_of(package, name, needs, monkeypatch)
    card = environment.card
    names = default_states(card, [field.name for field in card.state])
    world = build_world_model(compose("small", ["+scene", *SMALL, f"data.states={[*names]}"]), card)
    actions, fields = clips_of(environment, "train", EPISODES)
    states = side_by_side(fields, names)
    deviation = states.flatten(0, 1).std(0)
    world.model.prepare(states.mean((0, 1)), torch.where(deviation > 1e-6, deviation, 1.0))
    learn_motion(world, states, actions, steps=100, clips=EPISODES)
    world.eval()

    actions, true = clips_of(environment, "ind_test", 16)
    courses = world.model.decode(follow(world, side_by_side(true, names), actions))
    widths = [true[field][0, 0].numel() for field in names]
    predicted = dict(zip(names, courses.split(widths, 2), strict=True))
    shares = {}
    for field in moved:
        about, start = card.fields[field], true[field][:, :1].expand_as(true[field])
        errors = change(about, predicted[field].view_as(start), true[field])
        shares[field] = share(errors, change(about, start, true[field]))
    assert max(shares.values()) < 0.5, shares
