"""The part of an evaluation that asks the simulator: perturbed starts and other actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.environment import Environment
from acwm_core.errors import DataError
from acwm_core.evaluation.branches import most_branches
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.counterfactual import ROWS, chosen_plans, counterfactual, simulate_fans
from acwm_core.evaluation.evaluator import Evaluator, Video
from acwm_core.evaluation.findings import Counterfactual, Predictability
from acwm_core.evaluation.perturbed import perturbed_rows
from acwm_core.evaluation.plans import ClipPlan
from acwm_core.evaluation.scoring import Prediction, build_metrics, score, split_available
from acwm_core.evaluation.simulator import simulator_of
from acwm_core.metric import Metric

COUNTERFACTUAL, PERTURBED = "counterfactual", "perturbed"
"""Names of the two tests in `Summary.left_out`."""


@dataclass(frozen=True)
class Simulated:
    """What came of it, by split.

    Attributes:
        rows: of the kind ``perturbed``.
        predictability: how long clips can be foreseen.
        counterfactual: answers to other actions.
        videos: of branches.
        left_out: why a test or a metric could not be done, by its name.
    """

    rows: dict[str, list[ClipResult]] = field(default_factory=dict[str, list[ClipResult]])
    predictability: dict[str, Predictability] = field(default_factory=dict[str, Predictability])
    counterfactual: dict[str, Counterfactual] = field(default_factory=dict[str, Counterfactual])
    videos: list[Video] = field(default_factory=list[Video])
    left_out: dict[str, str] = field(default_factory=dict[str, str])


def units_of_work(evaluator: Evaluator, plans: Mapping[str, Sequence[ClipPlan]]) -> int:
    """How much `ask_simulator` tells its `advance` of at most, in rows of clips."""
    config, total = evaluator.config, 0
    branches = len(ROWS) * (1 + most_branches(evaluator.card.action))
    for each in plans.values():
        total += branches * len(chosen_plans(each, config.counterfactual_episodes))
        total += len(_perturbed_plans(evaluator, each))
    return total


def ask_simulator(
    evaluator: Evaluator,
    plans: Mapping[str, Sequence[ClipPlan]],
    datasets: Mapping[str, EpisodeDataset],
    advance: Callable[[int], None],
) -> Simulated:
    """Do the tests that need the simulator, as far as there is one and the config asks for them.

    Raises:
        RecipeError, UnknownNameError, MissingExtraError, PluginError: as `build_metrics`.
    """
    config, found = evaluator.config, Simulated()
    wanted = {COUNTERFACTUAL: config.counterfactual_episodes, PERTURBED: config.perturbed_episodes}
    if config.protocol != "full":
        wanted[PERTURBED] = 0  # windows begin in the middle, where nothing can be moved
    wanted = {name: count for name, count in wanted.items() if count}
    built = build_metrics(config.counterfactual_metrics, config.metric_options, of_branches=True)
    if not wanted:
        return found
    try:
        environment = simulator_of(next(iter(datasets.values())))
    except DataError as error:
        found.left_out.update(dict.fromkeys(wanted, str(error)))
        return found
    try:
        for split, episodes in datasets.items():
            if COUNTERFACTUAL in wanted and built:
                metrics, left_out = split_available(built, evaluator.card, evaluator.estimator)
                found.left_out.update(left_out)
                _answers(found, evaluator, environment, metrics, plans[split], episodes, advance)
            if PERTURBED in wanted:
                _perturb(found, evaluator, environment, split, plans[split], episodes, advance)
    finally:
        environment.close()
    return found


def _perturbed_plans(evaluator: Evaluator, plans: Sequence[ClipPlan]) -> Sequence[ClipPlan]:
    config = evaluator.config
    return plans[: config.perturbed_episodes] if config.protocol == "full" else ()


def _answers(
    found: Simulated,
    evaluator: Evaluator,
    environment: Environment,
    metrics: Mapping[str, Metric],
    plans: Sequence[ClipPlan],
    episodes: EpisodeDataset,
    advance: Callable[[int], None],
) -> None:
    few = chosen_plans(plans, evaluator.config.counterfactual_episodes)
    fans = simulate_fans(environment, few, episodes, evaluator.window)
    if few:
        answers, videos = counterfactual(evaluator, metrics, fans, advance)
        found.counterfactual[few[0].split] = answers
        found.videos.extend(videos if evaluator.config.videos else ())


def _perturb(
    found: Simulated,
    evaluator: Evaluator,
    environment: Environment,
    split: str,
    plans: Sequence[ClipPlan],
    episodes: EpisodeDataset,
    advance: Callable[[int], None],
) -> None:
    if not environment.can_be_perturbed:
        found.left_out[PERTURBED] = f"{evaluator.card.name} has no perturbed start"
        return

    def scored(prediction: Prediction) -> ClipResult:
        result = score(prediction, evaluator.metrics, evaluator.card, evaluator.estimator)
        advance(1)
        return result

    few = _perturbed_plans(evaluator, plans)
    rows, predictability = perturbed_rows(environment, few, episodes, scored)
    found.rows[split], found.predictability[split] = rows, predictability
