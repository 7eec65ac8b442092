"""A rope of nodes: they are read, moved and drawn, each learnt from the truth of the others."""

import numpy as np
import pytest
import torch

from acwm_core.model.conditioner import Conditioning
from acwm_scene.agent_sight import AgentSight, cell_places
from acwm_scene.group import at_frame
from acwm_scene.node_motion import NodeMotion
from acwm_scene.node_sight import HIDDEN, NodeSight, form_loss
from acwm_scene.node_windows import node_windows
from acwm_scene.nodes import Form, NodeBlock, NodeLayout, View, evenly, spacing, unstretched
from tests.scene.mechanics import CAMERA, NODES, model_of_ropes, ropes


def test_states_are_nodes_in_units():
    """Two agents and a cloth of three by two nodes, of which every second one is kept."""
    layout = NodeLayout(2, 3, [3, 2], 2, 0.1)
    form = layout.form(torch.arange(24.0)[None, None])
    assert (layout.shape, layout.axes) == ((2, 1), 3)
    torch.testing.assert_close(form.agents[0, 0, 1], torch.tensor([30.0, 40.0, 50.0]))
    torch.testing.assert_close(form.nodes[0, 0, 1], torch.tensor([180.0, 190.0, 200.0]))


@pytest.mark.parametrize("every", [1, 2, 3])
def test_forms_are_states_as_they_were_recorded(every):
    """Of a flat cloth, the nodes that are left out too."""
    down, across = torch.meshgrid(torch.arange(7.0), torch.arange(5.0), indexing="ij")
    nodes = torch.stack([down, 2 * across, down - across], -1).flatten()
    states = torch.cat([torch.arange(6.0), nodes])[None, None] * 0.3
    layout = NodeLayout(2, 3, [7, 5], every, 0.1)
    torch.testing.assert_close(layout.states(layout.form(states)), states)


def test_agents_alone_move_as_they_do_with_the_nodes(monkeypatch):
    """For who needs no more, without the work that the nodes are."""
    torch.manual_seed(0)
    model = model_of_ropes().eval()
    clips = Conditioning(torch.randn(3, 6, model.width), None, None)
    given = torch.randn(3, 1, 2, 8, 8)
    steps = [clips.frames(frame - 1, frame + 1) for frame in range(1, 6)]
    with torch.no_grad():
        whole = model.predict_states(given, clips, 6)
        begun = model.carry_states(given)
        some = begun.only([1, 7])
        both = torch.cat([some.advance(step) for step in steps], 1)
        torch.testing.assert_close(both, whole)
        monkeypatch.setattr(NodeMotion, "forward", lambda *_: pytest.fail("nodes are moved"))
        alone = begun.only([1]).picked(torch.arange(3))
        passed = torch.cat([alone.advance(step) for step in steps], 1)
    torch.testing.assert_close(passed[..., :2], whole[..., :2])
    torch.testing.assert_close(alone.current, passed[:, -1], equal_nan=True)
    assert passed[..., 2:].isnan().all()


@pytest.mark.parametrize("reach", [1, 4, 8, 20])
def test_nodes_hear_the_same_with_and_without_a_gradient(reach):
    """Along a rope, where planning takes another way to compute it; also from beyond its ends."""
    torch.manual_seed(0)
    block, features = NodeBlock(1, 8, reach), torch.randn(2, 9, 8)
    with torch.no_grad():
        alone = block(features, (9,))
    torch.testing.assert_close(alone, block(features, (9,)).detach())


@pytest.mark.parametrize("aspect", [1.0, 1.75])
def test_the_view_is_that_of_the_renderer(aspect):
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    pixels = CAMERA.project(points, 64, round(64 * aspect))
    seen = View(CAMERA, 0.1)(torch.tensor(points / 0.1, dtype=torch.float32), aspect)
    expected = pixels / [32 * aspect, 32, 0.1] - [1, 1, 0]
    torch.testing.assert_close(
        seen, torch.tensor(expected, dtype=torch.float32), rtol=1e-3, atol=1e-3
    )
    torch.testing.assert_close(
        View(CAMERA, 0.1).places(seen, aspect) / 10,
        torch.tensor(points, dtype=torch.float32),
        rtol=1e-4,
        atol=1e-4,
    )


def test_what_lies_on_the_ground_is_found_there():
    view, places = View(CAMERA, 0.1), 10 * torch.randn(7, 2)
    spots = view(places, 1.5)[..., :2]
    torch.testing.assert_close(view.on_ground(spots, 1.5), places, rtol=1e-3, atol=1e-3)
    above_the_horizon = view.on_ground(torch.tensor([0.0, -9.0]), 1.5)
    assert above_the_horizon.isfinite().all()


def test_nodes_are_put_at_equal_distances_along_their_line():
    """Against NumPy's interpolation of both coordinates along the length."""
    x = torch.tensor([0.0, 0.1, 0.2, 1.5, 2.0, 2.1, 4.0])
    line = torch.stack([x, 0.3 * x.sin()], -1)
    even = evenly(line[None])[0]
    far = np.append(0, np.hypot(*np.diff(line.numpy(), axis=0).T).cumsum())
    wanted = np.linspace(0, far[-1], 7)
    expected = np.stack([np.interp(wanted, far, each) for each in line.numpy().T], -1)
    np.testing.assert_allclose(even, expected, atol=0.03)
    np.testing.assert_allclose(even[[0, -1]], line[[0, -1]], atol=1e-6)
    steps = even.diff(dim=0).norm(dim=-1)
    assert steps.std() < 1e-3 * steps.mean()


def test_a_line_that_was_pulled_apart_is_as_long_as_it_was_again():
    """Its middle stays where it is, as nodes pull at each other alike."""
    line = torch.zeros(2, 9, 3)
    line[..., 0] = torch.linspace(0, 1, 9) ** 2 * torch.tensor([[8.0], [12.0]])
    made, apart = line, torch.tensor([1.0, 1.5])
    for _ in range(100):
        made = unstretched(made, (9,), apart)
    far = made.diff(dim=1).norm(dim=-1)
    assert (far <= 1.001 * apart[:, None]).all()
    torch.testing.assert_close(made.mean(1), line.mean(1))
    torch.testing.assert_close(unstretched(made, (9,), 2 * apart), made)  # what is slack is left


def test_a_cloth_is_as_far_apart_as_along_its_straight_side():
    """Its rows hang through, so that the ends of each are nearer together."""
    down, across = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    nodes = torch.stack([0.8 * across, torch.zeros_like(down), -down], -1).flatten(0, 1)[None]
    apart = spacing(nodes, (4, 5))
    torch.testing.assert_close(apart, torch.ones(1))
    torch.testing.assert_close(unstretched(nodes, (4, 5), apart), nodes)
    pulled = nodes * torch.tensor([1.0, 1.0, 1.5])
    for _ in range(100):
        pulled = unstretched(pulled, (4, 5), apart)
    assert (pulled.unflatten(1, (4, 5)).diff(dim=1).norm(dim=-1) <= 1.001).all()


def missed(sight, frames, true):
    """How far off a sight finds agents."""
    with torch.no_grad():
        return (sight(frames).places - true).norm(dim=-1).mean()


def learn_to_find(sight, optimizer, frames, true):
    """One step of training of a sight of agents."""
    optimizer.zero_grad()
    found = sight(frames)
    error = (found.places - true).norm(dim=-1).mean()
    (error + sight.loss(found, true, frames.shape[2:])).backward()
    optimizer.step()


def test_agents_are_told_by_what_they_look_like_and_not_by_their_side():
    """In all of the training the first agent is on the left."""
    torch.manual_seed(0)
    layout, view = NodeLayout(2, 2, [3], 1, 1.0), View(CAMERA, 1.0)
    sight = AgentSight(2, layout, view, None)
    optimizer = torch.optim.AdamW(sight.parameters(), 1e-2)

    def pictures(left):
        spots = torch.rand(32, 2, 2) * 0.8 + 0.1
        spots[:, left, 0] *= -1
        rows, columns = (((each + 1) * 8).long() for each in (spots[..., 1], spots[..., 0]))
        frames = torch.zeros(32, 2, 16, 16)
        for agent in range(2):
            frames[torch.arange(32), agent, rows[:, agent], columns[:, agent]] = 1
        middles = (torch.stack([columns, rows], -1) + 0.5) / 8 - 1
        return frames, view.on_ground(middles, 1.0)

    for _ in range(60):
        learn_to_find(sight, optimizer, *pictures(left=0))
    assert missed(sight, *pictures(left=0)) < 0.2
    assert missed(sight, *pictures(left=1)) < 0.2


@pytest.mark.ci
def test_a_shadow_tells_how_far_away_an_agent_is():
    """On the right, training shows it in mirrored frames alone, lit from the other side."""
    torch.manual_seed(0)
    light = torch.tensor([0.8, -0.5, 1.0])
    layout, view = NodeLayout(1, 3, [3], 1, 1.0), View(CAMERA, 1.0)
    sight = AgentSight(2, layout, view, light.tolist())
    optimizer = torch.optim.AdamW(sight.parameters(), 1e-2)
    cells = cell_places(torch.Size([16, 16]), torch.device("cpu"))

    def pictures(low, high, clips=16):
        share = torch.rand(clips, 1, 3)
        true = share * torch.tensor([high - low, 3.0, 1.6]) + torch.tensor([low, -1.5, 0.2])
        fallen = true - true[..., 2:] / light[2] * light
        seen = [view(each, 1.0)[..., :2] for each in (true, fallen)]
        spots = [torch.exp(-60 * (each - cells).square().sum(-1)) for each in seen]
        return torch.stack(spots, 1).unflatten(2, (16, 16)), true

    for step in range(100):
        frames, true = pictures(-2.0, 0.0)
        if step % 2:
            frames, true = frames.flip(3), true * torch.tensor([-1.0, 1.0, 1.0])
        learn_to_find(sight, optimizer, frames, true)
    frames, true = pictures(0.0, 2.0, clips=48)
    assert missed(sight, frames, true) < 0.2
    lightless = frames * torch.tensor([1.0, 0.0])[:, None, None]
    assert missed(sight, lightless, true) > 0.4


def test_agents_hear_of_each_other_how_high_they_would_be():
    """Nothing tells how far away the first one is, but that it is as high as the second."""
    layout, view = NodeLayout(2, 3, [3], 1, 1.0), View(CAMERA, 1.0)
    sight = AgentSight(2, layout, view, None)
    places = torch.randn(1, 2, 20, 3, generator=torch.Generator().manual_seed(0))
    fits = torch.zeros(1, 2, 20)
    fits[0, 1, 7] = 30.0
    heard = sight._heard(lambda told: -50 * told[..., :1].square(), fits, places)
    heights = places[0, ..., 2]
    assert heard[0, 0].argmax() == (heights[0] - heights[1, 7]).abs().argmin()
    assert heard[0, 1].std() < heard[0, 0].std()


def test_what_hangs_is_guessed_alike_however_its_agents_stand():
    torch.manual_seed(0)
    layout, view = NodeLayout(2, 3, [3, 3], 1, 1.0), View(CAMERA, 1.0)
    sight, hidden = NodeSight(2, layout, view, None, 8), torch.randn(1, HIDDEN)
    agents = torch.tensor([[[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0]]])
    apart = sight._guessed(hidden, agents) - agents.mean(1, keepdim=True)
    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    others = 2 * agents @ turn
    turned = sight._guessed(hidden, others) - others.mean(1, keepdim=True)
    torch.testing.assert_close(turned, 2 * apart @ turn)
    assert apart.std() > 0.1


def test_mixed_precision_moves_no_place_in_the_picture():
    points = 5 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    view = View(CAMERA, 0.1)
    exact = view(points, 1.0)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(view(points, 1.0), exact)


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
def test_a_cloth_moves_alike_whichever_way_its_grippers_stand(precision):
    torch.manual_seed(0)
    motion = NodeMotion(NodeLayout(2, 3, [5, 5], 1, 0.1), 32)
    torch.nn.init.normal_(motion.out.weight, std=0.3)
    sizes = ((3, 2, 3), (3, 25, 3), (3, 2, 3), (3, 25, 3))  # was, nodes, agents, change
    things = [torch.randn(size) for size in sizes]
    angle = torch.tensor(1.1)
    rows = [[angle.cos(), angle.sin(), 0], [-angle.sin(), angle.cos(), 0], [0, 0, 1]]
    turn = torch.tensor(rows)

    def moved(was, nodes, agents, change):
        with torch.autocast("cpu", precision, enabled=precision != torch.float32):
            return motion(Form(was, nodes), agents, change)[0]

    straight, turned = moved(*things), moved(*(each @ turn for each in things))
    assert (straight - things[1]).abs().mean() > 0.1
    torch.testing.assert_close(straight @ turn, turned, atol=1e-2, rtol=0)
    if precision == torch.float32:
        torch.testing.assert_close(straight @ turn, turned, atol=1e-5, rtol=1e-5)


def test_windows_are_seen_from_other_sides_and_ends():
    """What is turned, mirrored or counted from the other end keeps its distances."""
    layout = NodeLayout(1, 2, [NODES], 1, 1.0)
    true = layout.form(ropes(64, seed=0)[0])
    window = node_windows(true, torch.Generator().manual_seed(0), 0.5, ends=True)
    assert window.nodes.shape[1:] == (10, NODES, 2)
    ends = (window.nodes - window.agents).norm(dim=-1)[:, 1, [0, -1]].double()
    known = (true.nodes - true.agents).norm(dim=-1)[..., [0, -1]].flatten(0, 1).double()
    straight, round_about = (
        torch.cdist(ends, each).amin(1) < 1e-4 for each in (known, known.flip(1))
    )
    assert (straight | round_about).all()
    assert not straight.all()
    assert not round_about.all()
    moved = (window.nodes[:, -1] - window.nodes[:, 1]).abs().amax((1, 2)) > 0.05
    assert moved.float().mean() > 0.8


@pytest.mark.ci
def test_it_finds_a_line_in_a_picture_from_either_end():
    torch.manual_seed(0)
    layout = NodeLayout(1, 2, [NODES], 1, 1.0)
    view = View(CAMERA, 1.0)
    sight = NodeSight(2, layout, view, None, 24)
    optimizer = torch.optim.AdamW(sight.parameters(), 3e-3)
    sides = (torch.arange(12) + 0.5) / 6 - 1
    cells = torch.stack(torch.meshgrid(sides, sides, indexing="xy"), -1).flatten(0, 1)

    def pictures(clips, seed):
        true = layout.form(ropes(clips, seed)[0][:, :1])
        true = at_frame(true, 0)
        drawn = [
            torch.exp(-20 * (view(each, 1.0)[..., None, :2] - cells).square().sum(-1)).sum(1)
            for each in true
        ]
        return torch.stack(drawn, 1).unflatten(2, (12, 12)), true

    def missed(forms, true):
        other = true.reversed(torch.ones(len(true.nodes), dtype=torch.bool))
        return [torch.minimum(form_loss(each, true), form_loss(each, other)) for each in forms]

    for step in range(120):
        frames, true = pictures(64, step)
        optimizer.zero_grad()
        torch.stack(missed(sight.look(frames)[0], true)).mean().backward()
        optimizer.step()
    frames, true = pictures(64, 1000)
    with torch.no_grad():
        first, *_, last = missed(sight.look(frames)[0], true)
    assert last.mean() < 0.25
    assert last.mean() < first.mean()


def test_it_learns_to_draw_nodes_as_wrong_as_it_reads_them_and_in_its_order():
    torch.manual_seed(0)
    (group,) = model_of_ropes().groups.children()
    given, states = torch.randn(8, 2, 8, 8), ropes(8, seed=0)[0]
    true = group.encode(states)
    backwards = Form(true.agents, true.nodes.flip(-2))
    with torch.no_grad():
        course = group.train().as_read(given, true)
        read = group.sight(given)
    for clip in range(8):
        off = [
            (course.nodes[clip] - each.nodes[clip] - (read.nodes[clip] - each.nodes[clip, 0]))
            for each in (true, backwards)
        ]
        assert min(each.abs().max() for each in off) < 0.3
