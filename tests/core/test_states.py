"""Kinds of state fields: what a card refuses, codes that look-alikes share, and symmetries."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from acwm_core.checks.disc import Disc
from acwm_core.data.card import DatasetCard
from acwm_core.env.camera import Camera
from acwm_core.env.environment import EnvironmentCard, StateField
from acwm_core.env.physics import Reading, readings_of
from acwm_core.env.rotations import nearest_alike, product, rotations_of
from acwm_core.env.state_field import without_dangling
from acwm_core.env.states import code_size, decode, encode, transform
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import ShapeError
from acwm_core.files import typed

RNG = np.random.default_rng(0)
ABOVE = Camera(eye=(0.1, 0.2, 1.5), target=(0.1, 0.2, 0.0), up=(0, 1, 0), fov=30)
OBLIQUE = Camera(eye=(0.0, -2.0, 1.5), target=(0.0, 0.0, 0.3), fov=40)
DOWN = Camera.flat(0.5, (0.3, 0.4), down=True)
MIRROR, TURN = Symmetry((1,), mirrored=True), Symmetry((1,), quarter_turns=1)

POSE = StateField("pose", (3, 7), "m", "", ("position",) * 3 + ("quaternion",) * 4)
FIELDS = [
    StateField("value", (2, 5), "", ""),
    StateField("position", (3,), "m", "", "position"),
    StateField("presence", (4,), "", "", "presence"),
    StateField("curve", (6, 2), "m", "", "curve"),
    StateField("surface", (3, 4, 3), "m", "", "surface"),
    POSE,
    replace(POSE, symmetry="box"),
    replace(POSE, symmetry="cube"),
    *(
        StateField("angle", shape, "rad", "", "angle", symmetry=symmetry)
        for shape in ((), (3,), (2, 2))
        for symmetry in ("none", "half_turn", "quarter_turn")
    ),
    StateField("cup", (4,), "m", "", ("position", "position", "position", "angle")),
    StateField("mixed", (3,), "m", "", ("angle", "value", "angle")),
]


def turns(*shape):
    values = RNG.normal(size=(*shape, 4))
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def values_of(field, count=5):
    values = RNG.normal(size=(count, *field.shape))
    if field.kind == "presence":
        return (values > 0).astype(float)
    if "quaternion" in field.kinds:
        values[..., 3:] = turns(*values.shape[:-1])
    return values


@pytest.mark.parametrize("field", FIELDS, ids=lambda f: f"{f.name}-{f.symmetry}")
def test_values_come_back_from_their_code_and_tensors_have_the_same(field):
    values = values_of(field)
    code = encode(field, values)
    assert code.shape == (5, field.rows, code_size(field))
    np.testing.assert_allclose(decode(field, code, values), values, atol=1e-9)
    tensor = torch.from_numpy(values)
    np.testing.assert_allclose(encode(field, tensor).numpy(), code, atol=1e-12)
    single = encode(field, tensor.float())
    assert single.dtype == torch.float32
    found = decode(field, single, tensor.float())
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), values, atol=1e-5)
    np.testing.assert_allclose(
        decode(field, torch.from_numpy(code)), decode(field, code), atol=1e-9
    )


@pytest.mark.parametrize("symmetry", ["none", "box", "cube"])
def test_orientations_share_a_code_exactly_if_they_look_alike(symmetry):
    field = StateField("turn", (4,), "", "", "quaternion", symmetry=symmetry)
    first = turns(40)
    for rotation in rotations_of(symmetry):
        for sign in (1, -1):
            alike = sign * product(first, rotation)
            np.testing.assert_allclose(encode(field, alike), encode(field, first), atol=1e-12)
    apart = np.linalg.norm(encode(field, first)[:, None] - encode(field, first)[None], axis=-1)
    assert (apart + np.eye(40)[..., None]).min() > 1e-3


@pytest.mark.parametrize("symmetry", ["none", "box", "cube"])
def test_a_code_that_is_a_little_off_is_an_orientation_nearby(symmetry):
    field = StateField("turn", (4,), "", "", "quaternion", symmetry=symmetry)
    true = turns(200)
    code = encode(field, true)
    found = decode(field, code + RNG.normal(0, 0.01, code.shape), true)
    off = Rotation.from_quat(np.roll(true, -1, 1)).inv() * Rotation.from_quat(np.roll(found, -1, 1))
    assert off.magnitude().max() < math.radians(5)


def test_of_alike_values_the_nearest_is_decoded():
    yaw = StateField("yaw", (), "rad", "", "angle", symmetry="quarter_turn")
    assert decode(yaw, encode(yaw, np.float64(3.0))) == pytest.approx(3.0 - math.pi)
    assert decode(yaw, encode(yaw, np.float64(3.0)), np.float64(9.0)) == pytest.approx(
        3.0 + 2 * math.pi
    )
    upright = nearest_alike(np.array([0.0, 0, 0, -1]), "cube", np.array([1.0, 0, 0, 0]))
    np.testing.assert_allclose(upright, [1, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("camera", [ABOVE, OBLIQUE, DOWN])
@pytest.mark.parametrize("symmetry", [MIRROR, TURN, Symmetry((1,), True, 3)])
def test_transformed_places_are_where_the_transformed_picture_shows_them(camera, symmetry):
    field = StateField("place", (3,), "m", "", "position")
    places = RNG.uniform(-0.3, 0.3, (9, 3))
    seen = camera.to_frame(places)
    moved = camera.to_frame(transform(field, places, symmetry, camera))
    right, up = symmetry.plane @ (seen[:, :2] * [1, -1]).T
    np.testing.assert_allclose(moved, np.stack([right, -up, seen[:, 2]], -1), atol=1e-9)


@pytest.mark.parametrize("symmetry", [MIRROR, TURN, Symmetry((1,), True, 3)])
def test_a_body_turns_with_the_places_of_its_corners(symmetry):
    """A cone is the same in the mirror while it is not turned, as is assumed of all bodies."""
    corners = np.array([[0, 0, 1], [0.3, 0.2, -0.4], [-0.3, 0.2, -0.4]])
    turn = StateField("turn", (4,), "", "", "quaternion")
    place = StateField("place", (3, 3), "m", "", "position")
    at_origin = replace(ABOVE, eye=(0, 0, 1.5), target=(0, 0, 0))
    for quaternion in turns(5):
        body = Rotation.from_quat(np.roll(quaternion, -1)).apply(corners)
        wanted = transform(place, body, symmetry, at_origin)
        found = transform(turn, quaternion, symmetry, at_origin)
        again = Rotation.from_quat(np.roll(found, -1)).apply(corners)
        if symmetry.mirrored:  # the second and the third corner have changed places
            again = again[[0, 2, 1]]
        np.testing.assert_allclose(again, wanted, atol=1e-12)


def test_an_angle_is_transformed_as_the_quaternion_around_its_axis():
    yaw = StateField("yaw", (), "rad", "", "angle", axis=(0, 0, 2))
    turn = StateField("turn", (4,), "", "", "quaternion")
    angle = RNG.uniform(-3, 3, 20)
    zero = np.zeros(20)
    for camera in (ABOVE, DOWN):
        for symmetry in (MIRROR, TURN, Symmetry((1,), True, 1)):
            found = transform(yaw, angle, symmetry, camera)
            whole = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], -1)
            w, _, _, z = transform(turn, whole, symmetry, camera).T
            np.testing.assert_allclose(np.exp(1j * found), np.exp(2j * np.arctan2(z, w)), atol=1e-9)


def test_what_no_kind_tells_of_a_symmetry_is_refused():
    tilt = StateField("tilt", (), "rad", "", "angle", axis=(0, 1, 0))
    flat = StateField("place", (2,), "m", "", "position", height=0.1)
    joint = StateField("joint", (), "rad", "", "angle")
    value = StateField("value", (), "", "")
    for field, symmetry, camera in [
        (tilt, TURN, ABOVE),
        (flat, TURN, OBLIQUE),
        (joint, MIRROR, ABOVE),
        (value, MIRROR, ABOVE),
        (flat, MIRROR, None),
    ]:
        with pytest.raises(ShapeError, match=field.name):
            transform(field, np.zeros((1, *field.shape)), symmetry, camera)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "pose"},
        {"kind": "quaternion"},
        {"kind": "surface"},
        {"kind": ("position", "position")},
        {"kind": ("position", "presence", "presence")},
        {"kind": "position", "symmetry": "cube"},
        {"kind": "angle", "symmetry": "cube"},
        {"kind": "angle", "axis": (0, 0, 0)},
        {"kind": "position", "axis": (0, 0, 1)},
        {"kind": "position", "height": math.nan},
        {"kind": "position", "instances": ("a", "b", "c")},
        {"kind": "curve", "instances": ("a", "b")},
        {"follows": ("it",)},
    ],
)
def test_a_field_whose_options_do_not_fit_is_refused(wrong):
    with pytest.raises(ShapeError, match="the state field 'it'"):
        StateField("it", (2, 3), "", "", **wrong)


def with_state(*state, **more):
    return replace(Disc.card, state=state, **more)


@pytest.mark.parametrize(
    "state",
    [
        (StateField("it", (2,), "", "", follows=("other",)),),
        (StateField("it", (2,), "", "", present="other"),),
        (StateField("it", (2,), "m", "", "position", ("moon",)),),
        (StateField("it", (2,), "", "", present="there"), StateField("there", (2,), "", "")),
        (
            StateField("it", (), "", "", follows=("b",)),
            StateField("b", (), "", "", follows=("it",)),
        ),
    ],
)
def test_a_card_whose_fields_refer_to_nothing_is_refused(state):
    with pytest.raises(ShapeError, match="'it'"):
        with_state(*state)


def test_fields_that_are_kept_alone_refer_to_nothing():
    whole = (
        StateField("it", (2,), "", "", present="there", follows=("b",), instances=("disc",)),
        StateField("there", (2,), "", "", "presence", ("disc",)),
        StateField("b", (), "", ""),
    )
    assert without_dangling(whole, ("disc",)) == whole
    assert without_dangling(whole[:1], ()) == (StateField("it", (2,), "", ""),)


@pytest.mark.parametrize(
    "wrong",
    [
        {"eye": (0, 0)},
        {"eye": (0, 0, math.inf)},
        {"eye": (0, 0, 0)},
        {"eye": (0, 0, 1)},
        {"eye": (0, 1, 1), "fov": 180},
        {"eye": (0, 1, 1), "half_height": 0.0},
    ],
)
def test_numbers_that_are_no_camera_are_refused(wrong):
    with pytest.raises(ShapeError, match="camera"):
        Camera(**wrong)


@pytest.mark.parametrize("camera", [ABOVE, OBLIQUE, DOWN])
def test_cameras_see_tensors_as_arrays_and_points_are_found_again(camera):
    points = RNG.uniform(-0.3, 0.3, (7, 3))
    seen = camera.to_frame(points)
    np.testing.assert_allclose(camera.to_frame(torch.from_numpy(points)).numpy(), seen, atol=1e-12)
    np.testing.assert_allclose(camera.from_frame(seen), points, atol=1e-9)
    for point, at in zip(points, seen, strict=True):
        np.testing.assert_allclose(camera.on_plane(at[:2], point[2]), point, atol=1e-9)
    middle = camera.project(np.array([camera.target]), 60, 90)[0]
    np.testing.assert_allclose(middle[:2], [45, 30], atol=1e-9)


def test_a_card_with_a_scene_survives_json_and_stays_small_without():
    fields = json.loads(json.dumps(Disc.card.to_dict()))
    assert EnvironmentCard.from_dict(fields) == Disc.card
    typed(fields, EnvironmentCard)
    assert fields["state"][0].keys() == {
        "name", "shape", "unit", "description", "kind", "instances",
    }  # fmt: skip
    plain = Disc.card.recorded.to_dict()
    assert not {"camera", "light", "symmetries"} & plain.keys()
    assert plain["state"][0].keys() == {"name", "shape", "unit", "description"}


def dataset(environment, **more):
    return DatasetCard(environment, {"train": 1}, 0, {}, {}, 8, {}, **more)


def test_data_from_before_cards_knew_the_scene_is_the_same_data():
    old, new = dataset(Disc.card.recorded), dataset(Disc.card)
    assert old.differences(new) == new.differences(old) == []
    assert old.identity == new.identity
    assert old.environment.completed_by(new.environment) == Disc.card
    assert Disc.card.contradictions(old.environment) == []
    position, bearing = Disc.card.state
    state = (position, replace(bearing, symmetry="half_turn"))
    other = replace(Disc.card, camera=Camera.flat(0.7), state=state)
    assert Disc.card.contradictions(other) == ["camera", "state bearing"]


def test_readings_are_those_that_the_fields_declare():
    state = (
        StateField("there", (2,), "", "", "presence"),
        StateField("place", (2, 3), "m", "", "position", ("a", "b"), "there"),
        StateField(
            "cup", (4,), "m", "", ("position",) * 3 + ("angle",), ("c",), symmetry="half_turn"
        ),
        StateField("rope", (9, 2), "m", "", "curve", ("r",)),
        StateField("lonely", (3,), "m", "", "position"),
    )
    assert readings_of(state, "place", "cup", "rope") == (
        Reading("place", "position", ("a", "b"), present="there"),
        Reading("cup", "position", ("c",), columns=(0, 1, 2)),
        Reading("cup", "angle", ("c",), "half_turn", columns=(3,)),
        Reading("rope", "curve", ("r",)),
    )
    for name in ("there", "lonely", "nothing"):
        with pytest.raises(ShapeError, match=name):
            readings_of(state, name)
