import pytest

from acwm_play import simulator
from tests.play import follower, scenes


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run of push_cube whose model follows actions; tests must not change it."""
    pytest.importorskip("mujoco", reason="needs the extra rigid")
    return follower.make_run(tmp_path_factory.mktemp("play") / "follower")


@pytest.fixture(autouse=True)
def known_scenes(monkeypatch):
    """No test depends on the scene that is drawn."""
    monkeypatch.setattr(simulator, "secrets", scenes.known())
