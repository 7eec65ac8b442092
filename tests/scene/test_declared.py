"""Which groups a scene has: those that the environment's card declares, and nothing else says."""

from dataclasses import replace

import pytest

from acwm_core.env.camera import Camera
from acwm_core.env.card import StateField
from acwm_core.plugins import catalog
from acwm_scene.declared import default_states, groups_of, unit_of
from tests.tiny import TinyWorld


def card_of(name):
    return catalog().component("environment", name).load().card


def groups(card, *states):
    return groups_of(card, states)["specs"]


def test_push_cube_is_bodies_that_a_pusher_moves():
    card = card_of("push_cube")
    still = {"cube_present"}
    states = default_states(card, {each.name for each in card.state} - still)
    assert states == ("pusher_position", "cube_present", "cube_position", "cube_yaw")
    (spec,) = groups(card, *states).values()
    assert (spec.kind, spec.agents, spec.bodies, spec.folds, spec.axes) == ("bodies", 1, 5, 4, 3)
    assert spec.has_presence
    assert spec.columns == tuple(range(27))
    assert unit_of(spec.camera, "bodies") == pytest.approx(0.08, rel=0.01)


@pytest.mark.parametrize(
    ("name", "agents", "nodes", "axes"),
    [("push_rope", 1, (80,), 2), ("cloth_move", 2, (21, 21), 3)],
)
def test_ropes_and_cloths_are_nodes(name, agents, nodes, axes):
    card = card_of(name)
    moved = {field.name for field in card.state if "sphere" not in field.name}
    (spec,) = groups(card, *default_states(card, moved)).values()
    assert (spec.kind, spec.agents, spec.nodes, spec.axes) == ("nodes", agents, nodes, axes)
    assert spec.light == (card.light if axes == 3 else None)


def test_a_hand_follows_from_joints_that_are_learnt_and_no_others():
    card = card_of("robot_arm")
    (spec,) = groups(card, "hand_position", "joint_position").values()
    assert (spec.kind, spec.following) == ("values", 3)
    assert spec.columns == (3, 4, 5, 6, 7, 8, 9, 0, 1, 2)  # those that follow come last
    (alone,) = groups(card, "hand_position").values()
    assert alone.following == 0


def test_what_is_no_body_stands_beside_the_bodies():
    specs = groups(
        card_of("push_cube"), "pusher_position", "pusher_velocity", "cube_position", "cube_yaw"
    )
    assert {name: len(spec.columns) for name, spec in specs.items()} == {"bodies": 22, "values": 2}
    assert not specs["bodies"].has_presence


def test_a_world_of_a_third_party_needs_nothing_but_its_declaration():
    """As Push-T is: its T has corners, which are not agents, and its camera looks from below."""
    state = (
        StateField("agent", (2,), "px", "disc", kind="position", instances=("agent",)),
        StateField("block", (2,), "px", "T", kind="position", instances=("block",)),
        StateField("angle", (), "rad", "of the T", kind="angle", instances=("block",)),
        StateField("corners", (8, 2), "px", "of T", kind="position", instances=("block",)),
        StateField("goal", (2,), "px", "of the T"),
    )
    card = replace(
        TinyWorld.card,
        state=state,
        instances=("background", "agent", "block"),
        camera=Camera.flat(256, (256, 256), down=True),
        symmetries=(),
    )
    states = default_states(card, {"agent", "block", "angle", "corners"})
    assert states == ("agent", "block", "angle")
    (spec,) = groups(card, *states).values()
    assert (spec.kind, spec.agents, spec.bodies, spec.folds) == ("bodies", 1, 1, 1)


def test_without_a_camera_or_kinds_all_are_values():
    card = replace(card_of("push_cube"), camera=None)
    assert groups(card, "pusher_position", "cube_position", "cube_yaw").keys() == {"values"}
    plain = card.recorded
    (spec,) = groups(plain, "cube_yaw").values()
    assert (spec.kind, spec.angles) == ("values", ())
    (angle,) = groups(card, "cube_yaw").values()
    assert angle.angles == (0, 1, 2, 3, 4)


def test_without_states_nothing_is_declared():
    assert groups_of(card_of("push_cube"), ()) == {"specs": {}, "state_size": 0}
