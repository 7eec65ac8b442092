"""What holds of groups of every kind: they are read, moved and drawn, each from the truth."""

import pytest
import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_scene.group import tree_map
from tests.scene.dots import follow, learn_motion, world_of
from tests.scene.mechanics import FRAMES, KINDS


@pytest.fixture(params=KINDS)
def kind(request):
    torch.manual_seed(0)
    return KINDS[request.param]


def given_of(model, batch):
    return torch.randn(batch, 1, model.latent_channels, 8, 8)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("name", "parameters", "training", "share"),
    [
        ("values", {"following": 0}, {"steps": 150, "clips": 32}, 0.25),
        ("values", {"following": 2}, {"steps": 150, "clips": 32}, 0.25),
        ("bodies", {"channels": 48}, {"steps": 200}, 0.6),
        ("nodes", {}, {"steps": 200, "until": 1 / 3}, 0.5),
    ],
)
def test_it_learns_how_actions_move_things(name, parameters, training, share, monkeypatch):
    """Some steps predict whole clips with a share of the error of standing still."""
    monkeypatch.setattr("acwm_scene.node_windows.NODES", 4000)
    monkeypatch.setattr("acwm_scene.node_group.MOTION_CHANNELS", 32)
    kind = KINDS[name]
    world = world_of(kind.model(**parameters), stride=1, states=kind.model().state_size)
    learn_motion(world, *kind.clips(512 if name == "values" else 256, seed=0), **training)
    states, actions = kind.clips(64, seed=1)
    (group,) = world.model.groups.children()
    predicted = group.decode(follow(world, states, actions)[name])
    first, true, predicted = (
        values[..., kind.moved] for values in (states[:, 0], states[:, -1], predicted[:, -1])
    )
    moved = (first - true).norm(dim=-1).mean()
    assert (predicted - true).norm(dim=-1).mean() < share * moved


@pytest.mark.parametrize("noise", [0, 3])
def test_it_draws_the_states_that_it_predicts(kind, noise):
    """With these as true ones, it draws the same pictures, of the same draw."""
    model = kind.model(noise=noise).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    (group,) = model.groups.children()
    if kind is KINDS["values"]:
        group.prepare(torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.full((4,), 2.0))
    given, clips = given_of(model, 1), Conditioning(torch.randn(3, 6, model.width), None, None)

    def generators():
        return [torch.Generator().manual_seed(seed) for seed in range(3)]

    with torch.no_grad():
        states = model.predict_states(given, clips, 6, generators())
        given = given.expand(3, -1, -1, -1, -1)
        own = model(given, clips, 6, generators())
        first = tree_map(lambda values: values[:, None], group.frame(group.read(given)))
        numbers = torch.arange(5).expand(3, -1)
        drawn = model.draw_true(given, torch.cat([group.decode(first), states], 1), numbers)
    assert states.shape == (3, 5, model.state_size)
    torch.testing.assert_close(drawn, own, atol=1e-4, rtol=1e-3)


def test_it_draws_true_states_and_learns_nothing_of_motion_by_it(kind):
    model = kind.model().eval()
    torch.nn.init.normal_(model.drawing.out.weight)
    states, _ = kind.clips(2, seed=0)
    given, numbers = given_of(model, 2), torch.arange(FRAMES - 1).expand(2, -1)
    drawn = model.draw_true(given, states, numbers)
    drawn.square().mean().backward()
    (group,) = model.groups.children()
    idle = [*group.sight.parameters(), *model.motion_parameters()]
    assert all(each.grad is None for each in idle)
    other = states.clone()
    other[:, 9, :2] += 1
    changed = (model.draw_true(given, other, numbers) - drawn).abs().amax((0, 2, 3, 4))
    assert changed.nonzero().flatten().tolist() == [8]  # frame 9 is the 9th after the given one


def test_what_does_not_fit_is_refused(kind):
    with pytest.raises(RecipeError, match="at least 1"):
        kind.model(blocks=0)
    model = kind.model()
    with pytest.raises(ShapeError, match="SceneDynamics takes latents"):
        model.read(given_of(model, 1)[:, :, :1])
    with pytest.raises(RecipeError, match=r"scene takes actions .* conditioner=adaln"):
        model(given_of(model, 1), Conditioning(None, None, None), FRAMES)
    with pytest.raises(ShapeError, match=f"{model.state_size - 1} values, not {model.state_size}"):
        model.encode(kind.clips(1, seed=0)[0][..., :-1])
