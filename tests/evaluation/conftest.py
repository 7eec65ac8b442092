import pytest
import torch

from tests import tiny


@pytest.fixture(scope="session", autouse=True)
def parts():
    torch.set_num_threads(1)
    tiny.register()


@pytest.fixture(scope="session")
def data(parts, tmp_path_factory):
    return tiny.make_dataset(tmp_path_factory.mktemp("data") / "drift")


@pytest.fixture(scope="session")
def evaluated(data, tmp_path_factory):
    """An evaluated run; tests must not change it."""
    from acwm_interventions.evaluate import evaluate_run

    run = tiny.make_run(tmp_path_factory.mktemp("runs") / "first", data, **tiny.SWEEP)
    evaluate_run(run, progress=False)
    return run
