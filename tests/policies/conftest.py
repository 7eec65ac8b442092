import pytest
import torch

from tests.policies import slide


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    slide.register()


@pytest.fixture(scope="session")
def exact(parts, tmp_path_factory):
    """A run whose model knows its world; tests must not change it."""
    return slide.make_run(tmp_path_factory.mktemp("exact") / "run")


@pytest.fixture(scope="session")
def blind(parts, tmp_path_factory):
    """A run whose model ignores actions; tests must not change it."""
    return slide.make_run(tmp_path_factory.mktemp("blind") / "run", "blind")
