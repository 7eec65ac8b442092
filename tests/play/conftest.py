import pytest

from tests.play import follower


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run of push_cube whose model follows actions; tests must not change it."""
    pytest.importorskip("mujoco", reason="needs the extra rigid")
    return follower.make_run(tmp_path_factory.mktemp("play") / "follower")
