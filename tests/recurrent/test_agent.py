"""What a recurrent model knows of the agent: read from the first frame, moved by the actions."""

import pytest
import torch
from torch import nn

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.objective import Batch
from acwm_core.model.objectives.regression import Regression
from acwm_recurrent.recurrent import RecurrentModel
from tests.recurrent.dots import moving_dots, world_of

MODEL = {"channels": 8, "width": 32, "blocks": 0, "reading_blocks": 1}


def with_places(batch, seed):
    """Moving dots, and their places `[B, 6, 2]` in [−1.5, 1.5] as states to learn."""
    latents, moves = moving_dots(batch, seed)
    found = latents[:, :, 0].flatten(2).argmax(-1)
    return latents, moves, torch.stack([found // 8, found % 8], -1) / 2 - 1.75


def test_it_knows_where_the_agent_is_in_later_frames():
    """Its place is read from the first picture, and then told by the actions alone."""
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=2, state_size=2, **MODEL)
    world = world_of(model, stride=1, states=2)

    def batch(clips, seed):
        latents, moves, states = with_places(clips, seed)
        conditioning = world.conditioner.condition(world.normalise(moves), 6, model.width)
        return Batch(latents, conditioning, [torch.Generator().manual_seed(seed)] * clips, states)

    optimizer = torch.optim.AdamW([p for p in world.parameters() if p.requires_grad], 5e-3)
    for step in range(200):
        optimizer.zero_grad()
        model.state_loss(batch(64, step)).backward()
        optimizer.step()
    unseen = batch(256, 10_000)
    actions = model.actions(unseen.conditioning)
    agent, found = model.agent.start(unseen.latents[:, 0]), []
    for frame in range(1, 6):
        agent = model.agent.step(agent, actions[:, frame])
        found.append(agent.state)
    start, true = unseen.states[:, :1], unseen.states[:, 1:]
    inside = (unseen.states.diff(dim=1).abs() < 1).all(-1).all(-1)  # the dot leaves no edge
    error = (torch.stack(found, 1) - true)[inside].square().mean()
    assert error < 0.1 * (start - true)[inside].square().mean()


def test_states_teach_the_agent_and_the_picture_does_not_bend_it():
    torch.manual_seed(0)
    world = world_of(RecurrentModel(latent_channels=2, state_size=2, **MODEL), stride=1, states=2)
    nn.init.normal_(world.model.out.weight)  # both start at zero
    nn.init.normal_(world.model.reading_blocks[0].film.weight)
    latents, moves, states = with_places(2, 0)
    learnt = [*world.model.agent.look.parameters(), *world.model.agent.gru.parameters()]
    world.loss(latents, moves).backward()
    assert all(each.grad is None for each in learnt)
    assert world.model.agent.embed[0].weight.grad.abs().sum() > 0
    world.loss(latents, moves, states=states).backward()
    assert all(each.grad is not None for each in learnt)


def test_a_stream_carries_the_agent():
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=3, state_size=4, **MODEL | {"blocks": 1}).eval()
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.2)
    given, modulation = torch.randn(2, 1, 3, 8, 8), torch.randn(2, 4, 32)
    whole = model(given, Conditioning(modulation, None, None), 4)
    stream = model.stream(given, context=2)
    frames = [
        stream.advance(Conditioning(modulation[:, first:stop], None, None))
        for first, stop in ((0, 2), (1, 3), (2, 4))
    ]
    torch.testing.assert_close(torch.cat(frames, 1), whole)


def test_a_model_without_blocks_is_refused():
    with pytest.raises(RecipeError, match="needs blocks"):
        RecurrentModel(latent_channels=3, blocks=0)
    with pytest.raises(RecipeError, match="learns no states"):
        super(RecurrentModel, RecurrentModel(latent_channels=3)).state_loss(None)


def test_the_weight_of_states_is_that_of_the_objective():
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=2, state_size=2, **MODEL)
    latents, moves, states = with_places(2, 0)
    generators = [torch.Generator() for _ in latents]
    losses = []
    for weight in (0.0, 1.0, 2.0):
        torch.manual_seed(0)
        [each.manual_seed(0) for each in generators]
        world = world_of(model, 1, states=2, objective=Regression(state_weight=weight))
        torch.manual_seed(0)
        losses.append(world.loss(latents, moves, generators, states).item())
    assert losses[1] > losses[0]
    assert losses[2] - losses[1] == pytest.approx(losses[1] - losses[0], rel=1e-4)
