"""Symmetries: those that worlds declare hold in the simulator; groups act alike everywhere."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from acwm_core.checks.disc import Disc
from acwm_core.checks.environment import EnvironmentChecks
from acwm_core.checks.result import CheckFailure
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.symmetry import Symmetry, group
from acwm_core.errors import ShapeError

MIRROR = Symmetry((-1, 2), mirrored=True)
TURN = Symmetry((-2, 1), quarter_turns=1)

DECLARED = {
    "push_cube": 7,
    "push_cube_two_pushers": 7,
    "push_rope": 1,
    "push_sand": 1,
    "reacher": 1,
    "cloth_move": 1,
}
"""How many symmetries each world has, besides leaving all as it is; the others have none."""


@pytest.mark.parametrize(
    "world",
    [pytest.param(name, marks=[] if name == "reacher" else pytest.mark.ci) for name in DECLARED],
)
def test_a_transformed_start_leads_to_the_transformed_video(world):
    suite = EnvironmentChecks(world)
    assert len(suite.card.symmetries) == DECLARED[world]
    suite.symmetries_hold()


@pytest.mark.ci
def test_where_a_world_is_chaotic_a_wrong_symmetry_is_still_refused():
    cloth_move = pytest.importorskip("acwm_deformable.cloth_move").ClothMove
    (mirror,) = cloth_move.card.symmetries

    class Unmirrored(cloth_move):
        card = replace(cloth_move.card, symmetries=(replace(mirror, actions=(1, 2, 3)),))

    with pytest.raises(CheckFailure, match="state 'cloth_position' differs"):
        EnvironmentChecks(Unmirrored).symmetries_hold()


def test_a_group_is_closed_and_acts_alike_on_frames_and_on_the_plane():
    everything = group(MIRROR, TURN)
    assert len(everything) == 7
    picture = np.arange(16).reshape(4, 4)
    for second in everything:
        assert second.of_frames(picture).shape == picture.shape
        np.testing.assert_array_equal(second.of_actions(np.eye(2)), second.plane.T)
        for first in everything:
            both = second.after(first)
            twice = second.of_frames(first.of_frames(picture))
            np.testing.assert_array_equal(twice, both.of_frames(picture) if both else picture)
            plane = both.plane if both else np.eye(2)
            np.testing.assert_array_equal(second.plane @ first.plane, plane)


def test_a_dot_moves_in_the_frame_as_its_place_does_in_the_plane():
    for each in group(MIRROR, TURN):
        frame = np.zeros((5, 5), int)
        frame[0, 3] = 1  # one to the right of the middle and two up
        (row,), (column,) = np.nonzero(each.of_frames(frame))
        np.testing.assert_array_equal(each.plane @ [1, 2], [column - 2, 2 - row])


def test_a_heading_turns_as_the_direction_it_points_in():
    angles = np.linspace(-3, 3, 7)[:, None]
    named = [
        Symmetry(g.actions, g.mirrored, g.quarter_turns, headings=("yaw",)) for g in (MIRROR, TURN)
    ]
    for each in group(*named):
        x, y = each.plane @ [np.cos(angles[:, 0]), np.sin(angles[:, 0])]
        found = each.of_states("yaw", angles)[:, 0]
        assert np.abs(found).max() <= np.pi
        np.testing.assert_allclose([np.cos(found), np.sin(found)], [x, y], atol=1e-12)
        assert Symmetry.from_dict(json.loads(json.dumps(asdict(each)))) == each


def test_frames_that_would_change_their_size_are_left_out():
    assert [each.name for each in Disc.card.symmetries] == [
        "mirrored",
        "mirrored-turned180",
        "turned180",
    ]
    assert len(Disc(size=(64, 64)).card.symmetries) == 3


def test_a_card_keeps_its_symmetries_in_json():
    fields = json.loads(json.dumps(Disc.card.to_dict()))
    assert EnvironmentCard.from_dict(fields) == Disc.card


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Symmetry((-1, 2)),
        lambda: Symmetry((-1, 1), mirrored=True),
        lambda: Symmetry((0, 1), mirrored=True),
        lambda: Symmetry((1, 2), quarter_turns=4),
        lambda: group(MIRROR, Symmetry((1, 2), mirrored=True)),
        lambda: group(Symmetry((-2, 1), mirrored=True)),
    ],
)
def test_what_is_no_symmetry_is_refused(wrong):
    with pytest.raises(ShapeError):
        wrong()


def test_a_mirrored_world_may_repaint_what_its_card_says():
    both = Symmetry((-1, 2), mirrored=True, repainted=("cloth",))
    assert Symmetry.from_dict(json.loads(json.dumps(asdict(both)))) == both
    (mirrored, halfway, turned) = group(both, Symmetry((-1, -2), quarter_turns=2))
    assert [each.repainted for each in (mirrored, halfway, turned)] == [("cloth",), ("cloth",), ()]
