"""Simple mechanics for each kind of group, as states `[B, T, S]` and actions, and scenes of them.

All that happens follows from simple geometry: an arm lags behind its targets, and an agent pushes
what it meets straight away, to the distance `REACH`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from acwm_core.env.camera import Camera
from acwm_scene.declared import GroupSpec
from acwm_scene.scene import SceneDynamics

FRAMES, NODES, REACH = 17, 9, 1.0
SMALL = {"temporal_stride": 1, "channels": 16, "width": 32, "blocks": 1}

ABOVE = Camera((0.0, 0.0, 4.0), up=(0.0, 1.0, 0.0), fov=90.0)
"""A camera that sees 4 m from the middle of the picture to its upper edge."""

CAMERA = Camera((0.0, -6.0, 9.0), (0.0, 0.5, 0.0), fov=40.0)


def arms(clips, seed, frames=FRAMES):
    """Two joints of a planar arm that lag behind their targets, which the actions move; its hand.

    Standardised states: angles, and where the hand is.
    """
    random = torch.Generator().manual_seed(seed)
    actions = torch.rand(clips, frames, 2, generator=random).mul(2).sub(1)
    target = angle = torch.rand(clips, 2, generator=random).mul(2).sub(1)
    passed = [angle]
    for action in actions[:, :-1].unbind(1):
        target = target + 0.3 * action
        angle = angle + 0.5 * (target - angle)
        passed.append(angle)
    angles = torch.stack(passed, 1)
    elbow = angles.cumsum(2)
    hand = torch.stack([elbow.cos().sum(2), elbow.sin().sum(2)], -1)
    return torch.cat([angles, hand], -1), actions


def model_of_arms(following=0, angles=(), **parameters):
    spec = GroupSpec("values", (0, 1, 2, 3), following, angles)
    asked = {"latent_channels": 3, "specs": {"values": spec}, "state_size": 4}
    model = SceneDynamics(**asked | SMALL | parameters)
    model.prepare(torch.zeros(4), torch.ones(4))
    return model


def pushed(random, clips, frames, begin, reach):
    """Courses of an agent, of the things `[B, N, 2]` where they `begin`, and the actions."""
    actions = random.uniform(-1, 1, (clips, frames, 2)).astype(np.float32).repeat(4, 1)[:, :frames]
    agents, places = [random.uniform(-3, 3, (clips, 2))], [begin(random)]
    for action in actions[:, :-1].swapaxes(0, 1):
        agents.append(agents[-1] + 0.3 * (3 * action - agents[-1]))
        apart = places[-1] - agents[-1][:, None]
        far = np.linalg.norm(apart, axis=-1, keepdims=True).clip(1e-6)
        away = agents[-1][:, None] + apart / far * reach
        places.append(np.where(far < reach, away, places[-1]))
    places = np.stack(places, 1).reshape(clips, frames, -1)
    return np.stack(agents, 1), places, torch.tensor(actions)


def as_states(*parts):
    return torch.tensor(np.concatenate(parts, -1), dtype=torch.float32)


def pucks(clips, seed, frames=FRAMES, bodies=2, reach=REACH):
    """An agent, and pucks that it pushes."""

    def begin(random):
        return random.uniform(-2, 2, (clips, bodies, 2))

    agent, places, actions = pushed(np.random.default_rng(seed), clips, frames, begin, reach)
    present = np.ones((clips, frames, bodies))
    return as_states(agent, present, places, 0 * present), actions


def spec_of(agents=1, bodies=2, folds=4, axes=2):
    size = 2 * agents + bodies * (axes + 2)
    counts = {"agents": agents, "bodies": bodies, "folds": folds, "axes": axes}
    return GroupSpec("bodies", tuple(range(size)), **counts, has_presence=True, camera=ABOVE)


def model_of_pucks(**parameters):
    asked = {"latent_channels": 2, "unit": 1.0, "specs": {"bodies": spec_of()}, "state_size": 10}
    return SceneDynamics(**asked | SMALL | parameters)


def ropes(clips, seed, frames=FRAMES):
    """An agent, and a line of nodes that it pushes."""
    along = np.linspace(-1.5, 1.5, NODES)

    def begin(random):
        angle = random.uniform(0, 2 * math.pi, (clips, 1))
        return np.stack([np.cos(angle) * along, np.sin(angle) * along], -1)

    agent, places, actions = pushed(np.random.default_rng(seed), clips, frames, begin, REACH)
    return as_states(agent, places), actions


def model_of_ropes(**parameters):
    size = 2 + 2 * NODES
    spec = GroupSpec("nodes", tuple(range(size)), agents=1, axes=2, nodes=(NODES,), camera=CAMERA)
    asked = {"latent_channels": 2, "every": 1, "unit": 1.0, "specs": {"nodes": spec}}
    return SceneDynamics(**asked | {"state_size": size} | SMALL | parameters)


class Kind(NamedTuple):
    """A kind of group: its scene, its clips, and the columns of what actions move in the end."""

    model: Callable[..., Any]
    clips: Callable[..., Any]
    moved: slice


KINDS = {
    "values": Kind(model_of_arms, arms, slice(0, 4)),
    "bodies": Kind(model_of_pucks, pucks, slice(4, 8)),
    "nodes": Kind(model_of_ropes, ropes, slice(2, None)),
}
