import pytest
import torch

from acwm_core.data.generate import generate
from tests.tiny import register


@pytest.fixture(scope="session", autouse=True)
def tiny_parts():
    """The tiny parts, registered as a plugin of this process."""
    register()


@pytest.fixture(scope="session")
def data(tmp_path_factory, tiny_parts):
    """A dataset of eight training episodes of the tiny world: 12 clips to train on."""
    folder = tmp_path_factory.mktemp("data") / "tiny_world"
    generate("tiny_world", folder, episodes={"train": 8}, workers=0, progress=False)
    return folder


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
