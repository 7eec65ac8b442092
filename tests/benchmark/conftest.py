"""One small world, its tasks, a run that is evaluated, and the predictions of the run's model."""

import pytest

from acwm_core.data.generate import generate
from tests import tiny
from tests.benchmark.participant import predict
from tests.evaluation.conftest import parts

__all__ = ["parts"]

FEW = {"frames": 9, "noise_floor_episodes": 2, "perturbed_episodes": 2}


@pytest.fixture(scope="session")
def truth(parts, tmp_path_factory):
    """A folder with one dataset per world."""
    home = tmp_path_factory.mktemp("truth")
    generate(
        "slide",
        home / "slide",
        episodes={"ind_test": 6, "ood_test": 5},
        workers=0,
        progress=False,
    )
    return home


@pytest.fixture(scope="session")
def tasks(truth, tmp_path_factory):
    from acwm_benchmark.export import export_tasks

    words = [f"evaluation.{name}={value}" for name, value in FEW.items()]
    return export_tasks(
        ["slide"], tmp_path_factory.mktemp("tasks") / "tasks", data=truth, overrides=words
    ).folder


@pytest.fixture(scope="session")
def run(truth, tmp_path_factory):
    """An evaluated run, whose model draws in colours of 8 bits and is often wrong."""
    return evaluated(tiny.make_exact_run(tmp_path_factory.mktemp("runs") / "blind", "blind"), truth)


@pytest.fixture(scope="session")
def noisy_run(truth, tmp_path_factory):
    """An evaluated run, whose model denoises."""
    made = tmp_path_factory.mktemp("runs") / "noisy"
    return evaluated(tiny.make_run(made, truth / "slide", parts={"env": {"name": "slide"}}), truth)


def evaluated(run, truth, **more):
    from acwm_interventions.evaluate import evaluate_run

    settings = {**FEW, "steps_sweep": "[]", "device": "cpu", **more}
    words = [f"evaluation.{name}={value}" for name, value in settings.items()]
    evaluate_run(run, data=truth / "slide", overrides=words, overwrite=True, progress=False)
    return run


@pytest.fixture(scope="session")
def predictions(run, tasks, tmp_path_factory):
    """What the run's model predicts, as PNG."""
    return predict(run, tasks, tmp_path_factory.mktemp("predictions") / "png", "png")
