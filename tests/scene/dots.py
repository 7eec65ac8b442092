"""A world of dots that actions move by whole cells, and world models of given latents."""

import torch
from torch.nn import functional

from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_scene.group import at_frame, stacked, tree_map

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


def learn_motion(world, states, actions, *, steps=200, clips=64, until=1.0, rate=3e-3):
    """Teach a scene for some steps how things move."""
    optimizer = torch.optim.AdamW(world.parameters(), rate)
    random = torch.Generator().manual_seed(0)
    for step in range(steps):
        rows = torch.randint(len(states), (clips,), generator=random)
        length = world.codec.latent_frames(states.shape[1])
        conditioning = world.condition(actions[rows], length)
        progress = until * step / steps
        optimizer.zero_grad()
        loss = world.model.motion_loss(states[rows], conditioning, random, progress=progress)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(world.parameters(), 0.5)
        optimizer.step()


@torch.no_grad()
def follow(world, states, actions):
    """The courses of a scene that starts as the states say and follows the actions, by group."""
    model = world.model
    length = world.codec.latent_frames(states.shape[1])
    embedded = model.embed(world.condition(actions, length))
    courses = {}
    for name, group in model.groups.named_children():
        first = at_frame(group.encode(states[..., model.columns[name]]), 0)
        state, passed = group.begin(first, first), [stacked([first])]
        for actions_of_frame in embedded[name][:, 1:].unbind(1):
            state, course = group.move(state, actions_of_frame)
            passed.append(course)
        courses[name] = tree_map(lambda *values: torch.cat(values, 1), *passed)
    return courses


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
