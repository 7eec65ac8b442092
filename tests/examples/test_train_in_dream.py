"""The example that trains a policy in a dream: it learns, and what it learns holds in the truth."""

import importlib.util
from pathlib import Path

import pytest

import acwm
from tests import tiny

PATH = Path(__file__).parents[2] / "examples" / "train_in_dream.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("train_in_dream", PATH)
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def make_run(folder, model):
    tiny.register()
    acwm.register()
    return tiny.make_exact_run(folder / model, model)


def test_a_few_steps_of_it(example, tmp_path, capsys):
    words = ["--iterations", "1", "--candidates", "3", "--starts", "1", "--episodes", "2"]
    scores = example.main([str(make_run(tmp_path, "exact")), "place", *words])
    assert {*scores} == {"untrained", "trained"}
    assert all(returns < 0 for returns, _ in scores.values())
    assert "in the true simulator" in capsys.readouterr().out


@pytest.mark.slow
def test_what_is_learnt_in_an_exact_dream_holds_in_the_truth(example, tmp_path):
    """And nothing is learnt where the dream ignores actions."""
    words = ["place", "--iterations", "10", "--candidates", "24", "--starts", "3"]
    exact, blind = (
        example.main([str(make_run(tmp_path, model)), *words]) for model in ("exact", "blind")
    )
    assert exact["untrained"] == blind["untrained"]
    assert exact["trained"][0] > 0.6 * exact["untrained"][0]  # returns are negative
    assert exact["trained"][1] >= 0.25 > exact["untrained"][1]
    assert exact["trained"][0] > blind["trained"][0]
