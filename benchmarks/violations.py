"""How many violations the metrics find in videos with faults, and in true videos.

    python benchmarks/violations.py push_cube reacher --clips 100

Simulates new test episodes, every other one out of distribution: each once unchanged, and once with
every fault of `faults.py` from a third of its length on. It reads them with the estimators. The
table in docs/findings/physics.md is made by this program.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import click
from faults import FAULTS, NotPossibleError, with_fault
from rich.console import Console
from rich.table import Table

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.env.physics import StateEstimator
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.score import estimator_for
from acwm_metrics.conservation import violations

TRUE = "nothing (false alarms)"


@click.command()
@click.argument("worlds", nargs=-1)
@click.option("--clips", default=100, show_default=True, help="episodes per environment")
@click.option("--size", default=64, show_default=True, help="height of the frames")
@click.option("--frames", default=0, help="of each episode; all of them by default")
def main(worlds: tuple[str, ...], clips: int, size: int, frames: int) -> None:
    """Print a table of how often each fault is found."""
    table = Table("environment", "fault", "clips", "found", "%", "by")
    for world in worlds or FAULTS:
        found, by, count = Counter[str](), dict[str, Counter[str]](), Counter[str]()
        for fault, seen in checked(world, clips, size, frames):
            count[fault] += 1
            found[fault] += bool(seen)
            by.setdefault(fault, Counter()).update(seen)
        for fault in count:
            share = f"{100 * found[fault] / count[fault]:.1f}"
            why = ", ".join(f"{name} {n}" for name, n in by[fault].most_common(4))
            table.add_row(world, fault, str(count[fault]), str(found[fault]), share, why)
    Console(width=160).print(table)


def checked(world: str, clips: int, size: int, frames: int) -> Iterator[tuple[str, list[str]]]:
    """The fault in each clip, and the names of the violations found in it."""
    environment = make_environment(world, {"size": size})
    estimator = estimator_for(environment.card)
    if estimator is None:
        raise click.ClickException(f"no estimator reads the video of {world}")
    for index in range(clips):
        split = "ood_test" if index % 2 else "ind_test"
        spec = EpisodeSpec(world, split, index, seed=977, options={"size": size})
        true = simulate(environment, spec, frames=frames or None)
        prediction = Prediction.truth(true, environment.card, estimator)
        yield TRUE, _found(prediction)
        for name, fault in FAULTS[world].items():
            at = len(true.video) // 3
            try:
                wrong = with_fault(environment, spec, true.actions, fault, at)
            except NotPossibleError:
                continue
            yield name, _found(_predicted(prediction, wrong, estimator))


def _predicted(prediction: Prediction, wrong: Episode, estimator: StateEstimator) -> Prediction:
    video = as_clip(wrong.video)
    return replace(prediction, video=video, estimator=estimator)


def _found(prediction: Prediction) -> list[str]:
    return [name for name, frames in violations(prediction).items() if frames.any()]


if __name__ == "__main__":
    main()
