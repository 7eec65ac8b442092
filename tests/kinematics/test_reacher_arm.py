"""The physics of the reacher against Lagrange's equations, derived here by hand."""

from dataclasses import replace

import numpy as np
import pytest

from acwm_kinematics.reacher_arm import LINK_RADIUS, Arm, Links

LINKS = Links()
FREE = replace(LINKS, damping=0.0)
OTHER = Links(lengths=(0.5, 0.3), masses=(2.0, 3.0), damping=1.4)


def moments(links):
    """Inertia of each link about its middle: a solid cylinder across its axis, kg·m²."""
    return [
        m * (length**2 / 12 + LINK_RADIUS**2 / 4)
        for m, length in zip(links.masses, links.lengths, strict=True)
    ]


def inertia(links, q):
    """The mass matrix [2, 2] from the kinetic energy of two rods and two rotors.

    T = ½ (I₁ + m₁ (l₁/2)²) q̇₁² + ½ I₂ (q̇₁ + q̇₂)² + ½ m₂ v₂² + ½ r (q̇₁² + q̇₂²), where
    v₂² = l₁² q̇₁² + (l₂/2)² (q̇₁ + q̇₂)² + l₁ l₂ cos(q₂) q̇₁ (q̇₁ + q̇₂).
    """
    (upper, fore), (m1, m2), (i1, i2) = links.lengths, links.masses, moments(links)
    both = i2 + m2 * fore**2 / 4
    mixed = m2 * upper * fore / 2 * np.cos(q[1])
    first = i1 + m1 * upper**2 / 4 + m2 * upper**2 + both + 2 * mixed
    return np.array([[first + links.rotor, both + mixed], [both + mixed, both + links.rotor]])


def torque(links, q, v, a):
    """τ = M q̈ + h (−2 q̇₁ q̇₂ − q̇₂², q̇₁²) + b q̇, with h = m₂ l₁ (l₂/2) sin(q₂)."""
    h = links.masses[1] * links.lengths[0] * links.lengths[1] / 2 * np.sin(q[1])
    turning = h * np.array([-2 * v[0] * v[1] - v[1] ** 2, v[0] ** 2])
    return inertia(links, q) @ a + turning + links.damping * v


def acceleration(links, q, v, tau):
    return np.linalg.solve(inertia(links, q), tau - torque(links, q, v, np.zeros(2)))


def integrated(links, q, v, tau, seconds, steps):
    """The analytic equations, integrated by this test's own fourth-order Runge-Kutta."""
    y, h = np.array([q, v]), seconds / steps

    def rate(y):
        return np.array([y[1], acceleration(links, y[0], y[1], tau)])

    for _ in range(steps):
        k1 = rate(y)
        k2 = rate(y + h / 2 * k1)
        k3 = rate(y + h / 2 * k2)
        k4 = rate(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y


def energy(arm):
    return arm.velocities @ inertia(arm.links, arm.angles) @ arm.velocities / 2


def moving(links, angles=(0.4, 1.1), velocities=(2.0, -4.0)):
    arm = Arm(links, np.array(angles))
    arm.data.qvel[:] = velocities
    return arm


@pytest.mark.parametrize("links", [LINKS, FREE, OTHER], ids=["usual", "undamped", "other"])
def test_torques_are_those_of_the_analytic_manipulator(links):
    rng = np.random.default_rng(0)
    arm = Arm(links, np.zeros(2))
    for _ in range(20):
        q, v, a = rng.normal(0, 2, 2), rng.normal(0, 4, 2), rng.normal(0, 10, 2)
        np.testing.assert_allclose(
            arm.torque_for(q, v, a), torque(links, q, v, a), rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("links", [LINKS, OTHER], ids=["usual", "other"])
def test_it_moves_along_the_analytic_solution(links):
    arm, tau = moving(links), np.array([2.5, -1.5])
    arm.advance(tau, 1.0)
    q, v = integrated(links, [0.4, 1.1], [2.0, -4.0], tau, 1.0, 2000)
    np.testing.assert_allclose(arm.angles, q, atol=1e-5)
    np.testing.assert_allclose(arm.velocities, v, atol=1e-5)


def test_undriven_and_undamped_it_keeps_its_energy():
    arm = moving(FREE)
    before = energy(arm)
    for _ in range(49):
        arm.advance(np.zeros(2), 0.1)
        assert energy(arm) == pytest.approx(before, rel=1e-6)  # the requirement is 1 %
    assert np.abs(arm.angles - [0.4, 1.1]).max() > 2 * np.pi  # through every posture


def test_the_work_of_the_motors_becomes_kinetic_energy():
    arm, rng = moving(FREE, velocities=(0.0, 0.0)), np.random.default_rng(1)
    for _ in range(30):
        tau, start, before = rng.uniform(-3, 3, 2), arm.angles, energy(arm)
        arm.advance(tau, 0.1)
        work = tau @ (arm.angles - start)
        assert energy(arm) - before == pytest.approx(work, abs=1e-6)


def test_damping_only_takes_energy():
    arm = moving(LINKS)
    left = [energy(arm)]
    for _ in range(49):
        arm.advance(np.zeros(2), 0.1)
        left.append(energy(arm))
    assert (np.diff(left) < 0).all()
    assert left[-1] < 0.01 * left[0]


def test_driven_at_the_elbow_alone_it_keeps_the_momentum_about_the_shoulder():
    arm = moving(FREE, velocities=(0.0, 0.0))
    for tau in (3.0, -2.0, 1.0, 3.0):
        arm.advance(np.array([0.0, tau]), 0.3)
        momentum = inertia(FREE, arm.angles)[0] @ arm.velocities
        assert momentum == pytest.approx(0.0, abs=1e-6)
    assert abs(arm.velocities[0]) > 0.1


def test_points_and_speeds_follow_from_the_angles():
    arm = Arm(LINKS, np.array([np.pi / 2, -np.pi / 2]))
    np.testing.assert_allclose(arm.points(arm.angles), [[0, 0.5], [0.4, 0.5]], atol=1e-12)
    arm = moving(LINKS)
    before, speed = arm.tip, arm.tip_velocity
    arm.advance(np.zeros(2), 0.005)
    after = (arm.tip_velocity + speed) / 2
    np.testing.assert_allclose((arm.tip - before) / 0.005, after, atol=1e-3)


def test_angles_for_a_tip_bring_it_there_with_either_bend():
    arm, rng = Arm(LINKS, np.zeros(2)), np.random.default_rng(2)
    for _ in range(50):
        angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0.11, 0.89)
        tip = radius * np.array([np.cos(angle), np.sin(angle)])
        for bend in (-1, 1):
            angles = arm.angles_for(tip, bend)
            np.testing.assert_allclose(arm.points(angles)[1], tip, atol=1e-9)
            assert np.sign(angles[1]) == bend
    far = arm.points(arm.angles_for(np.array([2.0, 0.0]), 1))[1]
    np.testing.assert_allclose(far, [0.9, 0.0], atol=1e-9)  # as near as it gets
