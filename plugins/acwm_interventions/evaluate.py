"""`evaluate_run` with the tests that need the simulator, as `acwm evaluate` runs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.evaluation import evaluate
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.study import Clips, Findings
from acwm_interventions.interventions import intervene, units_of_work


class SimulatorStudy:
    """The counterfactual test, the predictability horizon and the simulator's ensembles."""

    def count_rows(self, evaluator: Evaluator, clips: Clips) -> int:
        """At most as many as `run` reports to `Evaluator.advance`."""
        return units_of_work(evaluator, clips)

    def run(
        self, evaluator: Evaluator, clips: Clips, datasets: Mapping[str, EpisodeDataset]
    ) -> Findings:
        """Run those tests that the settings ask for and the simulator allows."""
        made = intervene(evaluator, clips, datasets)
        splits = {
            split: {
                "counterfactual": made.counterfactual.get(split),
                "predictability": made.predictability.get(split),
            }
            for split in clips
        }
        ensembles = {"ensembles": made.ensembles}
        return Findings(made.scores, splits, ensembles, made.videos, made.left_out)


STUDIES = (SimulatorStudy(),)
"""What `acwm evaluate` does besides."""


def evaluate_run(run: str | Path, *, overrides: Sequence[str] = (), **options: Any) -> Summary:
    """`acwm_core.evaluation.evaluate.evaluate_run`, with `STUDIES`.

    If the simulator is installed, it also shows for a few clips what other actions would do, and
    gives the predictability horizon.

    Args:
        run: the run folder, or the name of a trained model.
        overrides: changes to the section `evaluation` of the run's recipe.
        **options: further arguments of that function.
    """
    return evaluate.evaluate_run(run, overrides=overrides, studies=STUDIES, **options)
