"""A world of dm_control, whose card declares its scene.

dm_control needs an older MuJoCo than acwm's own worlds, so it is in no environment of theirs:

    pip install --target dm dm-control "mujoco<4"
    PYTHONPATH=dm MUJOCO_GL=disabled pytest tests/examples/test_dm_control.py
"""

import pytest

pytest.importorskip("dm_control")

from acwm_core.checks import check_environment
from acwm_core.env.physics import readings_of
from tests.examples.dm_reacher import CARD, DmReacher


def test_it_conforms_and_what_it_declares_is_true():
    results = list(check_environment(DmReacher))
    assert [str(result) for result in results if not result.passed] == []


def test_metrics_read_what_the_card_declares():
    readings = readings_of(CARD.state, "finger_position", "joint_angle")
    assert [(each.kind, each.instances) for each in readings] == [
        ("position", ("finger",)),
        ("angle", ("arm", "hand")),
    ]
