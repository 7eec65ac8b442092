"""``python -m tests.play.serving RUN OUT PORT``: the real server, with drivers of the tests."""

import sys
from pathlib import Path

import pytest

from acwm_play import simulator
from acwm_play.serve import serve
from acwm_play.worlds import playable
from tests.play import drivers, follower, scenes

if __name__ == "__main__":
    run, out, port = sys.argv[1:]
    follower.register()
    drivers.register()
    drivers.plan_briefly(pytest.MonkeyPatch())
    simulator.secrets = scenes.known()
    serve(playable([Path(run)]), out=Path(out), port=int(port), browser=False)
