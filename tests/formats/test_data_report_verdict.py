"""The verdict of an evaluated run says whether its data's actions are those of its videos."""

import pytest

from acwm_core.recipe import compose
from acwm_core.training.fit import fit
from acwm_formats.arrays import Recording
from acwm_interventions.evaluate import evaluate_run
from acwm_report.run import EvaluatedRun
from tests.formats.test_data_report import blob, written


def recordings(first, count, exchanged):
    made = [blob(first + n, frames=33) for n in range(count)]
    if not exchanged:
        return made
    return [Recording(each.video, made[n - 1].actions) for n, each in enumerate(made)]


@pytest.mark.slow
@pytest.mark.parametrize("exchanged", [False, True])
def test_the_verdict_tells_right_actions_from_exchanged_ones(tmp_path, exchanged):
    data = written(tmp_path / "data", recordings(0, 96, exchanged), recordings(1000, 12, exchanged))
    steps = "trainer.max_steps=150"
    recipe = compose("small", [f"data.path={data}", steps, "training.cpu_threads=1"])
    run = tmp_path / "run"
    fit(recipe, run)
    evaluate_run(run)
    verdict = EvaluatedRun.read(run, "run").verdict
    assert ("action-insensitive" in verdict) == exchanged, verdict
