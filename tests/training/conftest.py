import pytest
import torch

from acwm_core.data.generate import generate
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import register
from tests.training.runs import killable


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


@pytest.fixture(scope="session")
def whole(data, tmp_path_factory):
    """One run that nobody interrupted."""
    return RunFolder(fit(killable(data), tmp_path_factory.mktemp("runs") / "whole"))


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
