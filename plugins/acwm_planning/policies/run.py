"""Rolls out the policies of `acwm rank`, and writes a ranking."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
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
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.results import write_json
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import duration
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_interventions.counterfactual import plan_branches
from acwm_planning.controllers import PolicyController
from acwm_planning.episode import EpisodeResult, EpisodeStart, load_task, spec_of_seed
from acwm_planning.policies.episode import Outcome, read_outcome, true_outcome
from acwm_planning.policies.judges import EpisodeSimulator, ModelJudge
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.ranking import RANKING_FILE, Ranking
from acwm_planning.policies.saved import is_policy, policy_for
from acwm_planning.policies.scripted import (
    ScriptedPolicy,
    built_in_policies,
    is_solvable,
    parse_policy,
)
from acwm_planning.policies.table import DECISION, DecisionLine, PolicyLine, summarise
from acwm_planning.resumable import Line, ResumableResults
from acwm_planning.runner import EpisodeTable, play_missing

SCRIPTED = "scripted"
"""Stands for all built-in scripted policies."""

TRIED_SEEDS = 20
"""How many next seeds may give the other actions of a decision, if some are solved at the start."""

BRANCHES = ("another", "still", "reversed", "mirrored")
"""Alternatives to a start's own actions in a decision; see `plan_branches`."""


class Ranker(EpisodeTable):
    """Rolls out policies in the true simulator and in a model of it.

    Args:
        simulator: the true simulator.
        model: the model that is compared with it.
        estimator: also reads the true frames, which shows the effect of its own errors.
        policies: policies to roll out.
        script: policy whose actions the decisions choose from; they have a row of their own.
    """

    def __init__(
        self,
        simulator: EpisodeSimulator,
        model: ModelJudge,
        estimator: StateEstimator,
        policies: Sequence[ScriptedPolicy | OwnPolicy],
        script: ScriptedPolicy,
    ) -> None:
        super().__init__([*(policy.name for policy in policies), DECISION])
        self.policies, self._script = list(policies), script
        self._simulator, self._model, self._estimator = simulator, model, estimator
        self._environment = simulator.environment
        self._steps = self._environment.task.max_steps

    def estimate(self, missing: Mapping[int, Sequence[str]]) -> str:
        """As playing and predicting one sequence takes."""
        card, batch = self._environment.environment.card, self._model.batch
        start = first_start(self._simulator, card, [*missing])
        began = time.perf_counter()
        actions = self._play(start, self._script).actions
        played = time.perf_counter()
        rows = len(self.policies) + 1 + len(BRANCHES)
        self._model.replay(start, [actions] * min(batch, rows))
        predicted = time.perf_counter() - played
        plays = len(self.policies) + 2 + 1 + len(BRANCHES)  # those of a decision are played again
        seconds = plays * (played - began) + -(-rows // batch) * predicted
        starts = f"{len(missing)} start{'s' * (len(missing) != 1)}"
        return f"about {duration(len(missing) * seconds)} for {starts}"

    def lines(self, seed: int, rows: Sequence[str]) -> list[Line]:
        start = self._simulator.start(spec_of_seed(self._environment.environment.card, seed))
        policies = [policy for policy in self.policies if policy.name in rows]
        episodes: dict[str, EpisodeResult] = {}
        scripted = [policy for policy in policies if isinstance(policy, ScriptedPolicy)]
        for policy in scripted:
            with self.left.trying(policy.name, seed):
                episodes[policy.name] = self._play(start, policy)
        branches: list[tuple[str, NDArray[np.float32]]] = []
        if DECISION in rows:
            with self.left.trying(DECISION, seed):
                branches = self._branches(start, seed)
        actions = [episode.actions for episode in episodes.values()]
        actions += [alternative for _, alternative in branches]
        outcomes = self._model.replay(start, actions) if actions else []
        lines: list[Line] = []
        for (name, episode), outcome in zip(episodes.items(), outcomes, strict=False):
            lines.append(self._line(name, seed, "open", start, episode, outcome))
        own = [policy for policy in policies if isinstance(policy, OwnPolicy)]
        for policy in own:
            with self.left.trying(policy.name, seed):
                episode = self._simulator.play_own(start, policy, self._steps)
                outcome = self._model.perform(start, policy, self._steps)
                lines.append(self._line(policy.name, seed, "closed", start, episode, outcome))
        if branches:
            lines.append(self._decision(start, seed, branches, outcomes[len(episodes) :]))
        return lines

    def _play(self, start: EpisodeStart, policy: ScriptedPolicy) -> EpisodeResult:
        return self._simulator.play(start, PolicyController(policy.begin), self._steps)

    def _judge(
        self, start: EpisodeStart, episode: EpisodeResult, model: Outcome
    ) -> dict[str, Outcome]:
        """The outcome of an episode by judge: the truth, the estimator, and the model."""
        observation = self._estimator.read(as_clip(episode.frames))
        read = read_outcome(observation, self._environment.task, start)
        return {"truth": true_outcome(episode, start), "estimator": read, "model": model}

    def _line(
        self,
        name: str,
        seed: int,
        loop: str,
        start: EpisodeStart,
        episode: EpisodeResult,
        model: Outcome,
    ) -> Line:
        judges = self._judge(start, episode, model)
        facts = {judge: outcome.facts() for judge, outcome in judges.items()}
        return {"policy": name, "seed": seed, "loop": loop, **facts}

    def _branches(self, start: EpisodeStart, seed: int) -> list[tuple[str, NDArray[np.float32]]]:
        """The script's own actions and their alternatives, `[T, A]` each."""
        card = self._environment.environment.card
        other = first_start(self._simulator, card, range(seed + 1, seed + 1 + TRIED_SEEDS))
        episodes = [self._play(begin, self._script) for begin in (other, start)]
        another, own = (np.pad(episode.actions, ((0, 1), (0, 0))) for episode in episodes)
        self._simulator.start(start.history.spec, start.goal)
        inner = self._environment.environment
        planned = plan_branches(own, another, inner.still_action(), inner.card.action)
        branches = [(branch.kind, branch.actions[:-1]) for branch in planned]
        return [("own", own[:-1]), *(branch for branch in branches if branch[0] in BRANCHES)]

    def _decision(
        self,
        start: EpisodeStart,
        seed: int,
        branches: Sequence[tuple[str, NDArray[np.float32]]],
        outcomes: Sequence[Outcome],
    ) -> Line:
        choices: list[dict[str, Any]] = []
        for (kind, actions), model in zip(branches, outcomes, strict=True):
            controller = PolicyController.replaying(actions)
            episode = self._simulator.play(start, controller, len(actions))
            judges = self._judge(start, episode, model)
            returns = {judge: outcome.returns / self._steps for judge, outcome in judges.items()}
            choices.append({"kind": kind, **returns})
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
        policies: `SCRIPTED`, names of scripted policies, or ``module:name`` or the folder of a
            user's own.
        seeds: numbers of the episodes, the same for all policies.
        out: the results folder.
        steps: sampling steps of the model; its own number by default.
        device: device of the model.
        progress: show a progress bar.
    """
    bundle, weights = load_run(run), file_sha256(RunFolder(find_run(run)).weights)
    card, goal_task = bundle.card, load_task(bundle.card.name, task)
    estimator = estimator_for(card)
    if estimator is None:
        raise DataError(
            f"no estimator reads the states of {card.name} from pictures, so what a model predicts "
            "cannot be judged"
        )
    world = bundle.world_model.to(choose_device(device))
    inner = make_environment(card.name, {"size": card.frame_size})
    try:
        environment = TaskEnvironment(inner, goal_task)
        stride = world.codec.temporal_stride
        simulator = EpisodeSimulator(environment, world.context_frames, stride, estimator)
        solved = is_solvable(inner, goal_task, first_start(simulator, card, seeds).goal)
        chosen = _parse_policies(policies, solved, goal_task, card)
        script = ScriptedPolicy("solution" if solved else "behaviour")
        model = ModelJudge(world, estimator, goal_task, steps=steps)
        ranker = Ranker(simulator, model, estimator, chosen, script)
        identity = {"environment": card.name, "task": task, "unit": goal_task.unit}
        settings = {"steps": steps, "weights": weights, "estimator": dict(estimator.provenance())}
        keys, kind = ("policy", "seed"), PolicyLine | DecisionLine
        results = ResumableResults(out, {**identity, **settings}, keys, kind)
        with results.adding():
            label = f"ranking at {task}" if progress else ""
            play_missing(ranker, results, seeds, progress=label)
            ranking = summarise(results)
            write_json(out / RANKING_FILE, ranking)
            return ranking
    finally:
        inner.close()


def first_start(
    simulator: EpisodeSimulator, card: EnvironmentCard, seeds: Sequence[int]
) -> EpisodeStart:
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
        elif ":" in word or is_policy(word):
            if is_policy(word):
                policy_for(word, card, task.name)
            parsed[word] = OwnPolicy(word, card)
        else:
            policy = parse_policy(word)
            if policy.script == "solution" and not solved:
                raise RecipeError(
                    f"the task {task.name!r} has no scripted solution: take behaviour"
                )
            parsed[policy.name] = policy
    return [*parsed.values()]
