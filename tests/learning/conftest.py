import pytest
import torch

from tests.learning import world


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    world.register()


@pytest.fixture(scope="session")
def run(parts, tmp_path_factory):
    """A run whose model knows its world; tests must not change it."""
    return world.make_run(tmp_path_factory.mktemp("known") / "run")
