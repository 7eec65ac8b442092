"""Rolls out policies for a run and a task, and writes a ranking."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.shards import file_sha256
from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.env.task import SolvedAtStartError, Task, TaskEnvironment
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.counterfactual import plan_branches
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.results import write_json
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import duration, progress_bar
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_planning.episode import spec_of_seed
from acwm_planning.left_out import LeftOut, passed_over
from acwm_planning.policies.episode import Outcome, PolicyEpisode, Start, read_outcome
from acwm_planning.policies.judges import Judge, ModelJudge, SimulatorJudge
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.ranking import RANKING_FILE, Ranking
from acwm_planning.policies.scripted import (
    ScriptedPolicy,
    built_in_policies,
    is_solvable,
    parse_policy,
)
from acwm_planning.policies.table import DECISION, DecisionLine, PolicyLine, summarise
from acwm_planning.resumable import Line, ResumableResults

SCRIPTED = "scripted"
"""Stands for all built-in scripted policies."""

TRIED_SEEDS = 20
"""How many next seeds may give the other actions of a decision, if some are solved at the start."""

BRANCHES = ("another", "still", "reversed", "mirrored")
"""Alternatives to a start's own actions in a decision; see `plan_branches`."""


class Ranker:
    """Rolls out policies in the true simulator and in a model of it.

    Args:
        simulator: the true simulator.
        model: the model that is compared with it.
        estimator: also reads the true frames, which shows the effect of its own errors.
        policies: policies to roll out.
        script: policy whose actions the decisions choose from.

    Attributes:
        left: what failed, and is left out.
    """

    def __init__(
        self,
        simulator: SimulatorJudge,
        model: Judge,
        estimator: StateEstimator,
        policies: Sequence[ScriptedPolicy | OwnPolicy],
        script: ScriptedPolicy,
    ) -> None:
        self.policies, self._script, self.left = list(policies), script, LeftOut()
        self._simulator, self._model, self._estimator = simulator, model, estimator
        self._environment = simulator.environment
        self._steps = self._environment.task.max_steps

    def names(self) -> list[str]:
        """Names of everything that is rolled out from a start: the policies, and the decision."""
        return [*(policy.name for policy in self.policies), DECISION]

    def seconds(self, seeds: Sequence[int]) -> float:
        """How long all takes from a start, about, as playing and predicting one sequence takes."""
        card, batch = self._environment.environment.card, self._model.batch
        start = first_start(self._simulator, card, seeds)
        began = time.perf_counter()
        actions = self._play(start, self._script).actions
        played = time.perf_counter()
        rows = len(self.policies) + 1 + len(BRANCHES)
        self._model.replay(start, [actions] * min(batch, rows))
        predicted = time.perf_counter() - played
        plays = len(self.policies) + 2 + 1 + len(BRANCHES)  # those of a decision are played again
        return plays * (played - began) + -(-rows // batch) * predicted

    def lines(self, seed: int, names: Sequence[str]) -> list[Line]:
        """Results for some of `names`, from the start of a seed, without those that fail."""
        start = self._simulator.start(spec_of_seed(self._environment.environment.card, seed))
        chosen = [policy for policy in self.policies if policy.name in names]
        episodes: dict[str, PolicyEpisode] = {}
        for policy in (each for each in chosen if isinstance(each, ScriptedPolicy)):
            with self.left.trying(policy.name, seed):
                episodes[policy.name] = self._play(start, policy)
        branches: list[tuple[str, NDArray[np.float32]]] = []
        if DECISION in names:
            with self.left.trying(DECISION, seed):
                branches = self._branches(start, seed)
        rows = [each.actions for each in episodes.values()] + [rows for _, rows in branches]
        outcomes = self._model.replay(start, rows) if rows else []
        lines: list[Line] = []
        for (name, true), seen in zip(episodes.items(), outcomes, strict=False):
            lines.append(self._line(name, seed, "open", start, true, seen))
        for policy in (each for each in chosen if isinstance(each, OwnPolicy)):
            with self.left.trying(policy.name, seed):
                true = self._simulator.play_own(start, policy, self._steps)
                seen = self._model.perform(start, policy, self._steps)
                lines.append(self._line(policy.name, seed, "closed", start, true, seen))
        if branches:
            lines.append(self._decision(start, seed, branches, outcomes[len(episodes) :]))
        return lines

    def _play(self, start: Start, policy: ScriptedPolicy) -> PolicyEpisode:
        task, goal = self._environment.task, start.goal
        return self._simulator.play(start, lambda env: policy.begin(env, task, goal), self._steps)

    def _read(self, start: Start, true: PolicyEpisode) -> Outcome:
        seen = self._estimator.read(as_clip(np.stack(true.frames)))
        return read_outcome(seen, self._environment.task, start)

    def _line(
        self, name: str, seed: int, loop: str, start: Start, true: PolicyEpisode, seen: Outcome
    ) -> Line:
        facts = {"policy": name, "seed": seed, "loop": loop, "truth": true.outcome.facts()}
        return {**facts, "estimator": self._read(start, true).facts(), "model": seen.facts()}

    def _branches(self, start: Start, seed: int) -> list[tuple[str, NDArray[np.float32]]]:
        """The script's own actions and their alternatives, `[T, A]` each."""
        card = self._environment.environment.card
        other = first_start(self._simulator, card, range(seed + 1, seed + 1 + TRIED_SEEDS))
        rows = [self._play(each, self._script).actions for each in (other, start)]
        self._simulator.start(start.spec, start.goal)
        inner = self._environment.environment
        another, own = (np.concatenate([each, np.zeros_like(each[:1])]) for each in rows)
        alternatives = plan_branches(own, another, inner.still_action(), inner.card.action)
        pairs = [(each.kind, each.actions[:-1]) for each in alternatives if each.kind in BRANCHES]
        return [("own", own[:-1]), *pairs]

    def _decision(
        self,
        start: Start,
        seed: int,
        branches: Sequence[tuple[str, NDArray[np.float32]]],
        outcomes: Sequence[Outcome],
    ) -> Line:
        choices: list[dict[str, Any]] = []
        for (kind, rows), seen in zip(branches, outcomes, strict=True):
            true = self._simulator.play(start, lambda _, r=rows: iter(r).__next__, len(rows))
            judges = {"truth": true.outcome, "estimator": self._read(start, true), "model": seen}
            each = {name: result.returns / self._steps for name, result in judges.items()}
            choices.append({"kind": kind, **each})
        return {"policy": DECISION, "seed": seed, "branches": choices}


def rank_policies(
    run: str | Path,
    task: str,
    policies: Sequence[str],
    *,
    seeds: Sequence[int],
    out: Path,
    steps: int | None = None,
    device: str = "auto",
    progress: bool = False,
) -> Ranking:
    """Roll out what is missing in `out`, and write the ranking of everything in it.

    Args:
        run: the run folder, or the name of a trained model.
        task: name of a task of its environment.
        policies: `SCRIPTED`, names of scripted policies, or ``module:name`` of a user's own.
        seeds: numbers of the episodes, the same for all policies.
        out: the results folder.
        steps: sampling steps of the model; its own number by default.
        device: device of the model.
        progress: show a progress bar.
    """
    bundle, weights = load_run(run), file_sha256(RunFolder(find_run(run)).weights)
    goal_task: Task = catalog().component("environment", bundle.card.name).load_task(task)
    estimator = estimator_for(bundle.card)
    if estimator is None:
        raise DataError(
            f"no estimator reads the states of {bundle.card.name} from pictures, so what a model "
            "predicts cannot be judged"
        )
    world = bundle.world_model.to(choose_device(device))
    inner = make_environment(bundle.card.name, {"size": bundle.card.frame_size})
    try:
        environment = TaskEnvironment(inner, goal_task)
        stride = world.codec.temporal_stride
        simulator = SimulatorJudge(environment, world.context_frames, stride, estimator)
        solved = is_solvable(inner, goal_task, first_start(simulator, bundle.card, seeds).goal)
        chosen = _parse_policies(policies, solved, goal_task, bundle.card)
        script = ScriptedPolicy("solution" if solved else "behaviour")
        model = ModelJudge(world, estimator, goal_task, steps=steps)
        ranker = Ranker(simulator, model, estimator, chosen, script)
        identity = {"environment": bundle.card.name, "task": task, "unit": goal_task.unit}
        settings = {"steps": steps, "weights": weights, "estimator": dict(estimator.provenance())}
        keys, kind = ("policy", "seed"), PolicyLine | DecisionLine
        results = ResumableResults(out, {**identity, **settings}, keys, kind)
        with results.adding():
            _roll_out(ranker, results, seeds, progress)
            ranking = summarise(results)
            write_json(out / RANKING_FILE, ranking)
            return ranking
    finally:
        inner.close()


def first_start(simulator: SimulatorJudge, card: EnvironmentCard, seeds: Sequence[int]) -> Start:
    """The start of the first seed that is not solved there."""
    for seed in seeds[:-1]:
        with contextlib.suppress(SolvedAtStartError):
            return simulator.start(spec_of_seed(card, seed))
    return simulator.start(spec_of_seed(card, seeds[-1]))


def _parse_policies(
    words: Sequence[str], solved: bool, task: Task, card: Any
) -> list[ScriptedPolicy | OwnPolicy]:
    parsed: dict[str, ScriptedPolicy | OwnPolicy] = {}
    for word in words:
        if word == SCRIPTED:
            parsed |= {policy.name: policy for policy in built_in_policies(solved)}
        elif ":" in word:
            parsed[word] = OwnPolicy(word, card)
        else:
            policy = parse_policy(word)
            if policy.script == "solution" and not solved:
                raise RecipeError(
                    f"the task {task.name!r} has no scripted solution: take behaviour"
                )
            parsed[policy.name] = policy
    return [*parsed.values()]


def _roll_out(
    ranker: Ranker, results: ResumableResults, seeds: Sequence[int], progress: bool
) -> None:
    finished = {(str(line["policy"]), int(line["seed"])) for line in results.finished()}
    missing = {seed: [n for n in ranker.names() if (n, seed) not in finished] for seed in seeds}
    total, count = len(seeds) * len(ranker.names()), sum(map(len, missing.values()))
    what = f"ranking at {results.settings['task']}"
    with progress_bar(what, total, done=total - count, shown=progress) as advance:
        left = [seed for seed, names in missing.items() if names]
        if progress and left:
            with passed_over():
                about = duration(len(left) * ranker.seconds(left))
                print(f"about {about} for {len(left)} starts", file=sys.stderr, flush=True)
        for seed in left:
            with ranker.left.trying("every policy", seed):
                results.add(*ranker.lines(seed, missing[seed]))
            advance(len(missing[seed]))
    if ranker.left.error and not results.finished():
        raise ranker.left.error
