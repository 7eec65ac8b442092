import numpy as np
import pytest
from acwm_pendulum.angle_error import AngleError
from acwm_pendulum.pendulum import GRAVITY, MASS, Pendulum

from acwm_core.checks import check_environment, check_metric


def swing(angle, length, frames):
    """Angles and velocities of an undamped pendulum released at rest."""
    env = Pendulum(size=16)
    env.reset(seed=0, options={"factors": {"length": length, "damping": 0.0}})
    env.motion = np.array([angle, 0.0])
    states = [env.step(np.zeros(1))[4]["state"] for _ in range(frames)]
    return [np.array([state[name] for state in states]) for name in ("angle", "velocity")]


def test_energy_is_conserved():
    angle, velocity = swing(2.5, 0.8, frames=200)
    energy = MASS * (0.5 * (0.8 * velocity) ** 2 - GRAVITY * 0.8 * np.cos(angle))
    assert np.ptp(energy) < 1e-4 * np.ptp(GRAVITY * 0.8 * np.cos(angle))


@pytest.mark.parametrize("length", [0.5, 1.0])
def test_small_swings_take_the_period_of_the_textbook(length):
    angle, _ = swing(0.01, length, frames=200)
    falls = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossings = falls + angle[falls] / (angle[falls] - angle[falls + 1])
    period = np.diff(crossings).mean() / Pendulum.card.fps
    assert period == pytest.approx(2 * np.pi * np.sqrt(length / GRAVITY), rel=1e-3)


def failures(results):
    return [str(result) for result in results if not result.passed]


def test_conforms():
    assert failures(check_environment(Pendulum)) == []
    assert failures(check_metric(AngleError, Pendulum)) == []
