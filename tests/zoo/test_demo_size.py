"""How much of the demo a machine has the time for."""

import pytest

from acwm_core.recipe import compose
from acwm_zoo import demo


def progress(pace):
    """Of a machine that took `pace` times the usual time for the steps so far."""
    done = demo.Progress(7)
    done.spent, done.expected = pace * 79.0, 79.0
    return done


@pytest.mark.parametrize(("pace", "share"), [(0.5, 1.0), (1.0, 1.0), (2.0, 0.5), (9.0, 0.35)])
def test_a_slow_machine_has_a_smaller_one(pace, share, tmp_path):
    assert demo.share_of_time(tmp_path, progress(pace)) == share


@pytest.mark.parametrize("pace", [1.0, 1.5, 2.0])
def test_all_steps_are_expected_to_fit(pace, tmp_path):
    share = demo.share_of_time(tmp_path, progress(pace))
    later = demo.SIMULATING * share + demo.TRAINING * share + demo.CLOSING
    assert pace * (79 + later) <= demo.SECONDS


def test_a_continued_demo_keeps_its_size(tmp_path):
    before = demo.share_of_time(tmp_path, progress(2.0))
    assert demo.share_of_time(tmp_path, demo.Progress(7)) == before < 1


def test_it_has_fewer_steps_and_the_same_model():
    whole = compose("demo")
    half = compose("demo", demo.fewer_steps(whole, 0.5))
    assert half.trainer["max_steps"] == whole.trainer["max_steps"] / 2
    ratio = half.objective.params["motion_steps"] / whole.objective.params["motion_steps"]
    assert ratio == 0.5
    assert half.model == whole.model
