import pytest
import torch

from tests import tiny


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    tiny.register()


@pytest.fixture(scope="session")
def run(parts, tmp_path_factory):
    """Tests must not change it."""
    return tiny.make_slide_run(tmp_path_factory.mktemp("planning"))
