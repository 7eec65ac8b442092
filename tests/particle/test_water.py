"""The physics of water: volume, rest, level, falling, and walls that nothing passes."""

import numpy as np
import pytest

from acwm_particle.cup import CLEARANCE, HIGH, LOW, THICKNESS, Cup, Vessel, tilted
from acwm_particle.kernels.water_step import GRAVITY
from acwm_particle.physics import SPACING
from acwm_particle.water import ALONE, FRAME, RADIUS, REACH, SUBSTEPS, Water, count_for

CUP, CONTAINER = Vessel(0.46, 1.2), Vessel(0.68, 0.8)
PLACE = np.array([0.6, 0.0])


def make_cup(pose=(-1.1, 0.0, 1.3, 0.0)):
    return Cup(CUP, CONTAINER, PLACE, np.array(pose))


def fill(level, pose=(-1.1, 0.0, 1.3, 0.0), frames=8):
    water = Water(make_cup(pose), level, 4.0, np.random.default_rng(0))
    water.settle(frames)
    return water


def wait(water, frames):
    for _ in range(frames):
        water.advance(np.zeros(4))


def surface(heights, flat, inner):
    """Height of the highest particle in each of 12 equal sectors and the middle, [13]."""
    rho, turn = np.hypot(*flat.T), np.arctan2(*flat.T)
    sector = np.floor((turn + np.pi) / (2 * np.pi) * 12).astype(int) % 12
    middle = heights[rho < inner / 3].max()
    return np.array(
        [heights[(sector == k) & (rho > inner / 3)].max() for k in range(12)] + [middle]
    )


def depth_in_walls(water):
    """How deep the deepest particle is in cup, container or table, in radii."""
    deepest = (RADIUS - water.particles[:, 2]).max()
    cup = water.cup
    foot = np.array([*cup.place, THICKNESS + cup.container.tall / 2])
    for shape, middle, tilt in (
        (cup.shape, cup.pose[:3], cup.pose[3]),
        (cup.container, foot, 0.0),
    ):
        local = (water.particles - middle) @ tilted(float(tilt))
        rho, z = np.hypot(local[:, 0], local[:, 1]), local[:, 2] + shape.tall / 2
        beside = np.abs(rho - shape.inner - THICKNESS / 2) - THICKNESS / 2
        above = np.maximum(z - shape.tall, -THICKNESS - z)
        wall = np.where(above < 0, beside, np.hypot(np.maximum(beside, 0), np.maximum(above, 0)))
        aside, below = rho - shape.inner, np.abs(z + THICKNESS / 2) - THICKNESS / 2
        floor = np.where(aside < 0, below, np.hypot(aside, np.maximum(below, 0)))
        deepest = max(deepest, (RADIUS - wall).max(), (RADIUS - floor).max())
    return deepest / RADIUS


@pytest.fixture(scope="module")
def still():
    water = fill(0.6)
    wait(water, 10)
    return water


@pytest.mark.parametrize("level", [0.25, 0.6, 0.95])
def test_water_is_at_rest_at_its_level_and_density(level):
    water = fill(level)
    before = water.numbered
    assert len(before) == count_for(level, CUP.inner)
    wait(water, 6)
    assert np.sqrt((water.velocities**2).sum(1).mean()) < 0.1
    assert np.linalg.norm(water.numbered - before, axis=1).mean() < RADIUS
    assert water.density.mean() == pytest.approx(1, abs=0.05)
    heights = water.particles[:, 2] - (water.cup.pose[2] - CUP.tall / 2)
    assert 2 * heights.mean() == pytest.approx(level, rel=0.05)
    tops = surface(heights, water.particles[:, :2] - water.cup.pose[:2], CUP.inner)
    assert tops.std() < 0.5 * RADIUS
    assert np.ptp(tops) < 2 * RADIUS
    # Level times area is the volume of as many cubes of water.
    volume = np.pi * CUP.inner**2 * (tops.mean() + RADIUS)
    assert volume == pytest.approx(len(heights) * SPACING**3, rel=0.08)
    assert water.touches == (True, False, False)


def test_the_number_of_particles_follows_from_the_volume():
    assert count_for(0.5, 0.46) * SPACING**3 == pytest.approx(np.pi * 0.46**2 * 0.5, rel=1e-3)
    lattice = np.stack(np.meshgrid(*[np.arange(-3, 4) * SPACING] * 3), -1).reshape(-1, 3)
    squares = (lattice**2).sum(1) / REACH**2
    assert ALONE * (np.maximum(1 - squares, 0) ** 3).sum() == pytest.approx(1)


def test_a_still_cup_keeps_still_and_so_does_its_water(still):
    pose = still.cup.pose.copy()
    energies = []
    for _ in range(15):
        wait(still, 1)
        energies.append((still.velocities.astype(float) ** 2).sum(1).mean() / 2)
    np.testing.assert_array_equal(still.cup.pose, pose)
    # Less than the water would gain by falling through a millimetre.
    assert max(energies) < GRAVITY * 0.001
    assert still.shares()[0] == 1


def test_a_drop_falls_by_half_g_t_squared():
    water = Water(make_cup(), 1e-4, 4.0, np.random.default_rng(0))
    assert len(water.particles) == 1
    water.particles[0] = [-2.2, 1.0, 2.5]
    wait(water, 5)
    dt, steps = FRAME / SUBSTEPS, 5 * SUBSTEPS
    fallen = 2.5 - float(water.particles[0, 2])
    # Symplectic Euler is ahead of the parabola by half a step's share.
    assert fallen == pytest.approx(GRAVITY * dt**2 * steps * (steps + 1) / 2, rel=1e-3)
    assert fallen == pytest.approx(GRAVITY * 0.5**2 / 2, rel=0.02)
    assert float(water.velocities[0, 2]) == pytest.approx(-GRAVITY * 0.5, rel=1e-3)
    wait(water, 8)
    assert float(water.particles[0, 2]) == pytest.approx(RADIUS, abs=1e-5)
    assert water.touches == (False, False, True)


def test_a_drop_that_falls_into_the_container_stays_in_it():
    water = Water(make_cup(), 1e-4, 4.0, np.random.default_rng(0))
    water.particles[0] = [0.6, 0.0, 0.7]
    water.velocities[0] = [4.0, 0.0, 0.0]  # nearly a wall's thickness per substep
    for _ in range(20):
        wait(water, 1)
        assert depth_in_walls(water) < 0.1
    np.testing.assert_array_equal(water.shares(), [0, 1, 0])


def test_pouring_conserves_water_and_nothing_enters_the_walls():
    water, rng = fill(0.5, (-0.35, 0.0, 1.65, 0.3)), np.random.default_rng(1)
    count, most = len(water.particles), -1.0
    for frame in range(60):
        lean = [0.0, 0.0, 0.0, 0.045 if frame < 40 else 0.0]
        water.advance(np.array(lean) + rng.normal(0, 0.02, 4) * [1, 1, 1, 0])
        most = max(most, depth_in_walls(water))
        assert sorted(water.number.tolist()) == list(range(count))
        assert np.isfinite(water.particles).all()
    assert most < 0.1
    assert water.shares()[1] > 0.5


def test_poured_water_is_level_in_the_container_with_its_volume():
    water = fill(0.5)
    count = len(water.particles)
    water.particles[:, :2] += PLACE - water.cup.pose[:2]
    water.particles[:, 2] += THICKNESS - (water.cup.pose[2] - CUP.tall / 2)
    wait(water, 30)
    np.testing.assert_array_equal(water.shares(), [0, 1, 0])
    tops = surface(water.particles[:, 2] - THICKNESS, water.particles[:, :2] - PLACE, 0.68)
    assert tops.std() < 0.6 * RADIUS
    level = count * SPACING**3 / (np.pi * 0.68**2)
    assert tops.mean() + RADIUS == pytest.approx(level, abs=RADIUS)


def test_viscous_water_flows_more_slowly():
    poured = []
    for viscosity in (4.0, 200.0):
        water = Water(make_cup((-0.35, 0, 1.65, 0)), 0.6, viscosity, np.random.default_rng(0))
        water.settle(5)
        for frame in range(26):
            water.advance(np.array([0, 0, 0, 0.06 if frame < 20 else 0]))
        poured.append(1 - water.shares()[0])
    assert poured[1] < 0.9 * poured[0]


def test_a_positive_tilt_leans_the_top_towards_positive_x():
    np.testing.assert_allclose(tilted(np.pi / 2) @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_wild_actions_never_bring_the_cup_into_container_or_table():
    cup, rng = make_cup(), np.random.default_rng(4)
    met = set()
    for _ in range(300):
        for pose in cup.advance(rng.uniform(-1, 1, 4) * 0.1 + [0.01, 0, -0.03, 0], FRAME, SUBSTEPS):
            points = cup.shape.outline @ tilted(float(pose[3])).T + pose[:3]
            assert points[:, 2].min() > CLEARANCE - 1e-9
            away = np.hypot(*(points[:, :2] - PLACE).T)
            within = (away < CONTAINER.outer - 0.02) & (
                points[:, 2] < CONTAINER.tall + THICKNESS - 0.02
            )
            assert not within.any()
        assert (cup.target >= LOW).all()
        assert (cup.target <= HIGH).all()
        met |= {cup.touches_container, 10 + cup.touches_table}
    assert met == {False, True, 10, 11}
