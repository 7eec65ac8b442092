import pytest
import torch

from tests import tiny


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    tiny.register()


@pytest.fixture(scope="session")
def exact(parts, tmp_path_factory):
    """A run whose model knows its world; tests must not change it."""
    return tiny.make_exact_run(tmp_path_factory.mktemp("exact") / "run")


@pytest.fixture(scope="session")
def blind(parts, tmp_path_factory):
    """A run whose model ignores actions; tests must not change it."""
    return tiny.make_exact_run(tmp_path_factory.mktemp("blind") / "run", "blind")
