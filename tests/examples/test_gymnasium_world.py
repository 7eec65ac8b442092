"""A world that was not made for acwm, whose card declares its scene: metrics and models read it."""

import pytest

pytest.importorskip("mujoco")

import torch

from acwm_core.checks import check_environment
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import readings_of
from acwm_core.model.build import build_world_model
from acwm_core.recipe import compose
from acwm_scene.declared import default_states, groups_of
from tests.examples.gymnasium_reacher import CARD, GymnasiumReacher


@pytest.mark.ci
def test_it_conforms_and_what_it_declares_is_true():
    results = list(check_environment(GymnasiumReacher))
    assert [str(result) for result in results if not result.passed] == []


def test_metrics_read_what_the_card_declares():
    readings = readings_of(CARD.state, "finger_position", "joint_angle")
    assert [(each.kind, each.instances) for each in readings] == [
        ("position", ("finger",)),
        ("angle", ("arm", "hand")),
    ]


def test_a_scene_reads_moves_and_draws_what_the_card_declares():
    states = default_states(CARD, [field.name for field in CARD.state])
    sizes = ["model.channels=8", "model.width=16", "model.blocks=1", f"data.states={[*states]}"]
    world = build_world_model(compose("small", ["+scene", *sizes]), CARD).eval()
    (group,) = groups_of(CARD, states)["specs"].values()
    assert (group.kind, group.angles, group.following) == ("values", (0, 1), 2)
    world.model.prepare(torch.zeros(8), torch.ones(8))
    episode = simulate(GymnasiumReacher(), EpisodeSpec("gymnasium_reacher", "train", 0), frames=9)
    frame = torch.from_numpy(episode.video[:1]).permute(0, 3, 1, 2) / 255
    actions = torch.from_numpy(episode.actions)[None]
    predicted = world.predict_states(frame, actions)
    assert {name: each.shape[2:] for name, each in predicted.items()} == {
        field.name: field.shape for field in CARD.state
    }
    assert predicted["joint_angle"].abs().max() <= torch.pi
    assert world.rollout(frame, actions).shape == (1, 9, 3, 64, 64)
