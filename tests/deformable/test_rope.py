"""The physics of the rope against Newton, Coulomb, Euler and Bernoulli."""

import numpy as np
import pytest

from acwm_core.errors import RecipeError
from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.rope import (
    DENSITY,
    GRAVITY,
    NODES,
    Cord,
    Rope,
)
from acwm_deformable.rope_curves import ROOM, lay_rope

AWAY = (50.0, 50.0)


def straight(cord, angle=0.0):
    along = np.linspace(-0.5, 0.5, NODES) * cord.length
    return along[:, None] * [np.cos(angle), np.sin(angle)]


def segments(nodes):
    return np.linalg.norm(np.diff(nodes.astype(float), axis=0), axis=1)


def gap(rope):
    """Between the surfaces of rope and pole, metres."""
    away = np.linalg.norm(rope.nodes.astype(float) - rope.pole, axis=1)
    return away.min() - rope.cord.radius - POLE_RADIUS


def closest_strands(rope):
    """Least distance of nodes that are no neighbours: more than half a turn of rope apart."""
    nodes = rope.nodes.astype(float)
    away = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    apart = int(np.ceil(np.pi * rope.cord.radius / rope.cord.spacing))
    return away[np.triu_indices(NODES, apart)].min()


def crossings(nodes):
    """How many pairs of segments that share no node cross each other."""
    a, b = nodes[:-1].astype(float), nodes[1:].astype(float)
    d = b - a
    # On which side of segment i, run along its length, both ends of segment j lie.
    side = [
        d[:, None, 0] * (end[None] - a[:, None])[..., 1]
        - d[:, None, 1] * (end[None] - a[:, None])[..., 0]
        for end in (a, b)
    ]
    split = side[0] * side[1] < 0
    i, j = np.nonzero(split & split.T)
    return int((j - i > 1).sum())


def energy(rope):
    """Kinetic and bending energy in joules."""
    cord, mass = rope.cord, DENSITY * rope.cord.length / NODES
    curl = np.diff(rope.nodes.astype(float), n=2, axis=0) / cord.spacing**2
    bending = 0.5 * cord.stiffness * cord.spacing * (curl**2).sum()
    return 0.5 * mass * (rope.velocities.astype(float) ** 2).sum() + bending


def bent(rope):
    """Root mean square of the curvature, 1/m."""
    curl = np.diff(rope.nodes.astype(float), n=2, axis=0) / rope.cord.spacing**2
    return float(np.sqrt((curl**2).sum(1).mean()))


def chase(cord, seed, frames=63):
    """A rope under a pole that races through it at top speed, frame by frame."""
    rng = np.random.default_rng(seed)
    rope = lay_rope(cord, rng)
    rope.pole[:] = rng.uniform(-0.9, 0.9, 2)
    while gap(rope) < 0.01:
        rope.pole[:] = rng.uniform(-0.9, 0.9, 2)
    aim = rope.nodes[NODES // 2]
    for _ in range(frames):
        if rng.random() < 0.15:
            aim = rope.nodes[rng.integers(NODES)] + rng.normal(0, 0.3, 2)
        way = aim - rope.pole
        rope.advance(way / (np.abs(way).max() + 1e-6) * 0.06)
        yield rope


EXTREMES = (
    Cord(2.0),
    Cord(2.8),
    Cord(3.1),
    Cord(2.4, stiffness=0.002),
    Cord(2.4, stiffness=0.5),
    Cord(2.4, friction=0.15),
    Cord(2.4, friction=1.4),
    Cord(2.4, radius=0.021),
    Cord(2.4, radius=0.055),
)


def in_words(cord):
    return f"L{cord.length:g} B{cord.stiffness:g} mu{cord.friction:g} r{cord.radius:g}"


@pytest.mark.parametrize("cord", EXTREMES, ids=in_words)
def test_nothing_stretches_or_passes_through_whatever_the_pole_does(cord):
    touched = 0
    for seed in (0, 1):
        for rope in chase(cord, seed):
            touched += rope.touched
            lengths = segments(rope.nodes)
            assert lengths.sum() == pytest.approx(cord.length, rel=1e-3)
            np.testing.assert_allclose(lengths, cord.spacing, rtol=0.01)
            assert gap(rope) > -0.1 * cord.radius
            assert closest_strands(rope) > 0.9 * 2 * cord.radius
            assert crossings(rope.nodes) == 0
    assert touched > 20


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2])
@pytest.mark.parametrize(("speed", "friction"), [(0.6, 0.2), (1.0, 0.5), (1.5, 1.0)])
def test_a_sliding_rope_stops_after_v_squared_over_2_mu_g(speed, friction, angle):
    rope = Rope(Cord(2.4, friction=friction), straight(Cord(2.4), angle), AWAY)
    start = rope.nodes.copy()
    rope.velocities[:] = (0.0, speed)
    rope.advance((0.0, 0.0), 0.05)
    slower = speed - friction * GRAVITY * 0.05
    np.testing.assert_allclose(rope.velocities, np.tile((0.0, slower), (NODES, 1)), atol=2e-3)
    for _ in range(10):
        rope.advance((0.0, 0.0))
    moved = rope.nodes - start
    np.testing.assert_allclose(moved[:, 1], speed**2 / (2 * friction * GRAVITY), rtol=0.03)
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=1e-3)
    assert np.abs(rope.velocities).max() < 1e-3


@pytest.mark.parametrize("cord", EXTREMES, ids=in_words)
def test_a_rope_that_nobody_touches_stays_still(cord):
    rope = lay_rope(cord, np.random.default_rng(3))
    start = rope.nodes.copy()
    for _ in range(63):
        rope.advance((0.0, 0.0))
    assert np.abs(rope.nodes - start).max() < 2e-5
    assert np.abs(rope.velocities).max() < 1e-4


def test_a_pushed_rope_comes_to_rest_once_the_pole_is_gone():
    *_, rope = chase(Cord(2.4), seed=5, frames=40)
    rope.pole[:] = AWAY
    for _ in range(10):
        rope.advance((0.0, 0.0))
    before = rope.nodes.copy()
    rope.advance((0.0, 0.0))
    assert np.abs(rope.nodes - before).max() < 1e-5


def test_without_friction_momentum_is_kept_and_energy_does_not_grow():
    cord = Cord(2.4, friction=0.0)
    rope = Rope(cord, straight(cord), AWAY)
    along = np.linspace(0, 1, NODES)
    rope.velocities[:, 0] = 0.1
    rope.velocities[:, 1] = 0.3 + 0.4 * np.sin(2 * np.pi * along) + 0.3 * np.cos(5 * np.pi * along)
    momentum, before = rope.velocities.astype(float).sum(0), energy(rope)
    for _ in range(40):
        rope.advance((0.0, 0.0))
        now = energy(rope)
        assert now < before * (1 + 1e-4)
        before = now
        np.testing.assert_allclose(rope.velocities.sum(0), momentum, rtol=2e-3, atol=2e-3)
    assert bent(rope) > 1.0  # it did not move as a rigid rod


def test_friction_only_takes_energy_away():
    cord = Cord(2.4, friction=0.3)
    rope = Rope(cord, straight(cord), AWAY)
    rope.velocities[:, 1] = 1.5 * np.sin(3 * np.pi * np.linspace(0, 1, NODES))
    energies = [energy(rope)]
    for _ in range(50):
        rope.advance((0.0, 0.0), 0.02)
        energies.append(energy(rope))
    assert (np.diff(energies) < 1e-5).all()
    assert energies[-1] < 0.2 * energies[0]
    assert np.abs(rope.velocities).max() < 1e-3


@pytest.mark.parametrize("stiffness", [0.1, 0.4])
def test_a_free_rope_vibrates_like_an_euler_bernoulli_beam(stiffness):
    cord = Cord(2.0, stiffness=stiffness, friction=0.0)
    beta = 4.73004 / cord.length  # first mode of a free beam
    s = np.linspace(0, cord.length, NODES)
    ratio = (np.cosh(4.73004) - np.cos(4.73004)) / (np.sinh(4.73004) - np.sin(4.73004))
    mode = np.cosh(beta * s) + np.cos(beta * s) - ratio * (np.sinh(beta * s) + np.sin(beta * s))
    rope = Rope(cord, straight(cord), AWAY)
    rope.velocities[:, 1] = 0.05 * mode
    expected = 2 * np.pi / (beta**2 * np.sqrt(stiffness / DENSITY))
    heights, dt = [0.0], 0.02
    while len(heights) * dt < 1.3 * expected:
        rope.advance((0.0, 0.0), dt, substeps=5)
        heights.append(float(rope.nodes[:, 1] @ mode))
    h = np.array(heights)
    down, up = (
        np.flatnonzero((h[:-1] > 0) & (h[1:] <= 0)),
        np.flatnonzero((h[:-1] < 0) & (h[1:] >= 0)),
    )
    half = down[0] + h[down[0]] / (h[down[0]] - h[down[0] + 1])
    full = up[0] + h[up[0]] / (h[up[0]] - h[up[0] + 1])
    assert 2 * (full - half) * dt == pytest.approx(expected, rel=0.03)


def test_a_push_in_the_middle_bends_both_halves_alike():
    rope = Rope(Cord(2.4), straight(Cord(2.4)), (0.0, -0.15))
    for _ in range(12):
        rope.advance((0.0, 0.05))
    assert rope.nodes[:, 1].max() > 0.4
    np.testing.assert_allclose(rope.nodes, rope.nodes[::-1] * (-1, 1), atol=2e-3)


def test_the_mirror_image_of_a_push_gives_the_mirror_image():
    cord, flip = Cord(2.4), np.array([1, -1], np.float32)
    nodes = lay_rope(cord, np.random.default_rng(2)).nodes
    pole = nodes[20] + 0.12 * np.array([0.6, -0.8], np.float32)
    one, other = Rope(cord, nodes, pole), Rope(cord, nodes * flip, pole * flip)
    touched = 0
    for _ in range(15):
        one.advance((-0.03, 0.04))
        other.advance((-0.03, -0.04))
        touched += one.touched
    assert touched > 3
    np.testing.assert_allclose(other.nodes, one.nodes * flip, atol=1e-5)


def push_middle(cord, frames=10):
    rope = Rope(cord, straight(cord), (0.0, -0.12))
    for _ in range(frames):
        rope.advance((0.0, 0.05))
    return rope


def test_a_pushed_rope_lies_against_the_pole():
    rope = push_middle(Cord(2.4))
    assert rope.touched
    assert gap(rope) == pytest.approx(0, abs=2e-3)
    assert rope.nodes[NODES // 2, 1] == pytest.approx(rope.pole[1] + 0.105, abs=3e-3)


def test_a_stiffer_rope_bends_less():
    soft, usual, stiff = (bent(push_middle(Cord(2.4, stiffness=b))) for b in (0.004, 0.05, 0.4))
    assert soft > 1.15 * usual
    assert usual > 1.5 * stiff


def test_a_slicker_table_bends_the_rope_less():
    slick, rough = (bent(push_middle(Cord(2.4, friction=mu))) for mu in (0.15, 1.4))
    assert rough > 1.3 * slick


def test_a_rough_pole_drags_the_rope_along():
    moved = []
    for friction in (0.0, 0.6):
        cord = Cord(2.4, pole_friction=friction)
        rope = Rope(cord, straight(cord), (-0.3, -0.12))
        for _ in range(12):
            rope.advance((0.05, 0.02))
        moved.append(rope.nodes[:, 0].mean())
    assert moved[1] > moved[0] + 0.05


def test_finer_steps_give_the_same_shape():
    ends = []
    for substeps in (25, 50):
        rope = Rope(Cord(2.4), straight(Cord(2.4)), (0.3, -0.12))
        for _ in range(12):
            rope.advance((-0.01, 0.05), substeps=substeps)
        ends.append(rope.nodes.copy())
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 0.01


def test_ropes_are_laid_in_the_room_with_space_between_strands():
    ways = set()
    for seed in range(60):
        cord = Cord((2.0, 2.4, 2.8, 3.1)[seed % 4])
        nodes = lay_rope(cord, np.random.default_rng(seed)).nodes
        assert (np.abs(nodes) <= ROOM).all()
        assert crossings(nodes) == 0
        assert segments(nodes).sum() == pytest.approx(cord.length, rel=1e-4)
        chord = nodes[-1] - nodes[0]
        ways.add(int(np.arctan2(chord[1], chord[0]) // (np.pi / 4)))
    assert len(ways) == 8  # they lie in every direction


def test_a_rope_that_cannot_lie_on_the_table_is_refused():
    with pytest.raises(RecipeError, match="shorter or softer"):
        lay_rope(Cord(3.3, stiffness=5.0), np.random.default_rng(0))
