import pytest
import torch

from acwm_core.data.generate import generate
from tests import tiny


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    tiny.register()


@pytest.fixture(scope="session")
def data(parts, tmp_path_factory):
    """Episodes of the world; tests must not change them."""
    folder = tmp_path_factory.mktemp("slide") / "data"
    generate("slide", folder, episodes={"train": 4}, workers=0, progress=False)
    return folder


@pytest.fixture(scope="session")
def run(data, tmp_path_factory):
    """A run whose model knows its world; tests must not change it."""
    return tiny.make_exact_run(tmp_path_factory.mktemp("dream") / "run", path=str(data))
