"""A dream of a model of recorded data, which has no simulator to begin with."""

import gymnasium
import numpy as np
import pytest

import acwm
from acwm_core.errors import AcwmWarning
from tests.play.test_recorded import recording
from tests.play.test_recorded import run as run

acwm.register()


def test_it_begins_with_an_episode_of_the_data(run):
    with pytest.warns(AcwmWarning, match="no simulator"):
        env = gymnasium.make("acwm/dream-v0", run=run, device="cpu")
    frame, _ = env.reset(seed=0)
    np.testing.assert_allclose(frame.astype(int), recording(0).video[0], atol=1)
    frame, reward, *_ = env.step(np.array([0.5, 0.0], np.float32))
    assert reward == 0
    assert (frame > 250).all(-1).any()  # the model's disc
