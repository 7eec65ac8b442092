import pytest

from tests.experiment.forking import Server
from tests.experiment.parts import write_experiment


@pytest.fixture(scope="session")
def acwm(tmp_path_factory):
    """Runs commands of `acwm` with the tiny parts."""
    server = Server(tmp_path_factory.mktemp("server"))
    yield server
    server.close()


@pytest.fixture(scope="session")
def whole(acwm, tmp_path_factory):
    """An experiment that nobody disturbed: its folder, and what was printed."""
    folder = tmp_path_factory.mktemp("whole")
    write_experiment(folder)
    code, out, err = acwm("experiment", "widths.yaml", cwd=folder)
    assert code == 0, out + err
    return folder, out, err
