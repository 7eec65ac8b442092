"""`evaluate_run` with the tests that need the simulator, as `acwm evaluate` runs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

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


def evaluate_run(
    run: str | Path,
    *,
    data: str | Path | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Summary:
    """Predict and score every test clip of a run's dataset, and write the results.

    The model is compared with three reference rows on the same clips: a copy of the first frame,
    the model with another episode's actions, and the codec's reconstruction. If the simulator is
    installed, it also shows for a few clips what other actions would do, and gives the
    predictability horizon. The same run, data and settings give the same numbers, whatever the
    batch size (up to float32 rounding).

    Writes ``RUN/evaluation/``: ``episodes.parquet``, ``summary.json`` and ``videos/``. A result of
    other weights with the same settings is replaced.

    Args:
        run: the run folder, or the name of a trained model.
        data: the data folder; the recipe's by default.
        overrides: changes to the section `evaluation` of the run's recipe
            (``evaluation.steps=10``).
        out: a folder to write to instead of `run`; it can be reported and compared like a run.
        overwrite: replace a result that was made with other settings, or on other data.
        progress: show a progress bar on the terminal.

    Returns:
        The content of ``summary.json``.
    """
    return evaluate.evaluate_run(
        run,
        data=data,
        overrides=overrides,
        out=out,
        overwrite=overwrite,
        progress=progress,
        studies=STUDIES,
    )
