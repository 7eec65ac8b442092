"""Encoding never makes the process a real-time one."""

import os

import numpy as np
import pytest

from acwm_benchmark.lossy import LossyClip, LossyVideo
from acwm_benchmark.videos import Coding

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_getscheduler"), reason="only Linux has such priorities"
)


def test_av1_leaves_the_scheduling_as_it_was():
    before = os.sched_getscheduler(0)
    video = np.zeros((2, 64, 64, 3), np.float32)
    LossyVideo(Coding("av1", "yuv420p"), [LossyClip(10**6, video)], 10)
    assert os.sched_getscheduler(0) == before == os.SCHED_OTHER
