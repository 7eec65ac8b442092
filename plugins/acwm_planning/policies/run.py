"""Rolls out policies for a run and a task, and writes a ranking."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.shards import file_sha256
from acwm_core.data.simulate import make_environment
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import StateEstimator
from acwm_core.env.task import Task, TaskEnvironment
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.interventions import plan_branches
from acwm_core.evaluation.results import write_json
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import progress_bar
from acwm_core.plugins import catalog
from acwm_core.training.run import RunFolder, load_run
from acwm_core.training.trained import find_run
from acwm_planning.policies.episode import Outcome, PolicyEpisode, Start, judged
from acwm_planning.policies.own import OwnPolicy
from acwm_planning.policies.ranking import FILE, Ranking
from acwm_planning.policies.scripted import ScriptedPolicy, declared, scripted, solvable
from acwm_planning.policies.stages import ModelStage, SimulatorStage, Stage, as_video
from acwm_planning.policies.table import DECISION, summarise
from acwm_planning.resumable import Line, ResumableResults

SPLIT = "ind_test"
"""Split of the episodes, on which no model was trained; a seed is an episode's number in it."""

SCRIPTED = "scripted"
"""Stands for all declared scripted policies."""

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
    """

    def __init__(
        self,
        simulator: SimulatorStage,
        model: Stage,
        estimator: StateEstimator,
        policies: Sequence[ScriptedPolicy | OwnPolicy],
        script: ScriptedPolicy,
    ) -> None:
        self.policies, self._script = list(policies), script
        self._simulator, self._model, self._estimator = simulator, model, estimator
        self._stage = simulator.environment
        self._steps = self._stage.task.max_steps

    def names(self) -> list[str]:
        """Names of everything that is rolled out from a start: the policies, and the decision."""
        return [*(policy.name for policy in self.policies), DECISION]

    def lines(self, seed: int, wanted: Sequence[str]) -> list[Line]:
        """Results for some of `names`, from the start of a seed."""
        start = self._simulator.start(self._spec(seed))
        chosen = [policy for policy in self.policies if policy.name in wanted]
        open_loop = [policy for policy in chosen if isinstance(policy, ScriptedPolicy)]
        played = [self._played(start, policy) for policy in open_loop]
        branches = self._branches(start, seed) if DECISION in wanted else []
        rows = [each.actions for each in played] + [rows for _, rows in branches]
        imagined = self._model.replay(start, rows) if rows else []
        made: list[Line] = []
        for policy, true, seen in zip(open_loop, played, imagined, strict=False):
            made.append(self._line(policy.name, seed, "open", start, true, seen))
        for policy in (each for each in chosen if isinstance(each, OwnPolicy)):
            true = self._simulator.performed(start, policy, self._steps)
            seen = self._model.perform(start, policy, self._steps)
            made.append(self._line(policy.name, seed, "closed", start, true, seen))
        if branches:
            made.append(self._decision(start, seed, branches, imagined[len(played) :]))
        return made

    def _spec(self, seed: int) -> EpisodeSpec:
        card = self._stage.environment.card
        return EpisodeSpec(card.name, SPLIT, seed, options={"size": card.frame_size})

    def _played(self, start: Start, policy: ScriptedPolicy) -> PolicyEpisode:
        task, goal = self._stage.task, start.goal
        return self._simulator.play(start, lambda env: policy.begin(env, task, goal), self._steps)

    def _read(self, start: Start, true: PolicyEpisode) -> Outcome:
        seen = self._estimator.read(as_video(np.stack(true.frames)))
        return judged(seen, self._stage.task, start)

    def _line(
        self, name: str, seed: int, loop: str, start: Start, true: PolicyEpisode, seen: Outcome
    ) -> Line:
        facts = {"policy": name, "seed": seed, "loop": loop, "truth": true.outcome.facts()}
        return {**facts, "estimator": self._read(start, true).facts(), "model": seen.facts()}

    def _branches(self, start: Start, seed: int) -> list[tuple[str, NDArray[np.float32]]]:
        """The script's own actions and their alternatives, `[T, A]` each."""
        other = self._simulator.start(self._spec(seed + 1))
        rows = [self._played(each, self._script).actions for each in (other, start)]
        self._simulator.start(start.spec, start.goal)
        inner = self._stage.environment
        another, own = (np.concatenate([each, np.zeros_like(each[:1])]) for each in rows)
        made = plan_branches(own, another, inner.still_action(), inner.card.action)
        kept = [(each.kind, each.actions[:-1]) for each in made if each.kind in BRANCHES]
        return [("own", own[:-1]), *kept]

    def _decision(
        self,
        start: Start,
        seed: int,
        branches: Sequence[tuple[str, NDArray[np.float32]]],
        imagined: Sequence[Outcome],
    ) -> Line:
        found: list[dict[str, Any]] = []
        for (kind, rows), seen in zip(branches, imagined, strict=True):
            true = self._simulator.play(start, lambda _, r=rows: iter(r).__next__, len(rows))
            judges = {"truth": true.outcome, "estimator": self._read(start, true), "model": seen}
            each = {name: result.returns / self._steps for name, result in judges.items()}
            found.append({"kind": kind, **each})
        return {"policy": DECISION, "seed": seed, "branches": found}


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

    Raises:
        AcwmError: the policies cannot be rolled out or ranked.
    """
    bundle, weights = load_run(run), file_sha256(RunFolder(find_run(run)).weights)
    found: Task = catalog().component("environment", bundle.card.name).load_task(task)
    estimator = estimator_for(bundle.card)
    if estimator is None:
        raise DataError(
            f"no estimator reads the states of {bundle.card.name} from pictures, so what a model "
            "predicts cannot be judged"
        )
    world = bundle.world_model.to(choose_device(device))
    inner = make_environment(bundle.card.name, {"size": bundle.card.frame_size})
    try:
        stage = TaskEnvironment(inner, found)
        stride = world.codec.temporal_stride
        simulator = SimulatorStage(stage, world.context_frames, stride, estimator)
        first = EpisodeSpec(bundle.card.name, SPLIT, seeds[0], options={"size": inner.frame_size})
        solved = solvable(inner, found, simulator.start(first).goal)
        chosen = _chosen(policies, solved, found, bundle.card)
        script = ScriptedPolicy("solution" if solved else "behaviour")
        model = ModelStage(world, estimator, found, steps=steps)
        ranker = Ranker(simulator, model, estimator, chosen, script)
        identity = {"environment": bundle.card.name, "task": task, "unit": found.unit}
        asked = {"steps": steps, "weights": weights, "estimator": dict(estimator.provenance())}
        results = ResumableResults(out, {**identity, **asked}, ("policy", "seed"))
        with results.adding():
            _roll_out(ranker, results, seeds, progress)
            ranking = summarise(results)
            write_json(out / FILE, ranking)
            return ranking
    finally:
        inner.close()


def _chosen(
    words: Sequence[str], solved: bool, task: Task, card: Any
) -> list[ScriptedPolicy | OwnPolicy]:
    made: dict[str, ScriptedPolicy | OwnPolicy] = {}
    for word in words:
        if word == SCRIPTED:
            made |= {policy.name: policy for policy in declared(solved)}
        elif ":" in word:
            made[word] = OwnPolicy(word, card)
        else:
            policy = scripted(word)
            if policy.script == "solution" and not solved:
                raise RecipeError(
                    f"the task {task.name!r} has no scripted solution: take behaviour"
                )
            made[policy.name] = policy
    return [*made.values()]


def _roll_out(
    ranker: Ranker, results: ResumableResults, seeds: Sequence[int], progress: bool
) -> None:
    done = {(str(line["policy"]), int(line["seed"])) for line in results.finished()}
    left = {seed: [n for n in ranker.names() if (n, seed) not in done] for seed in seeds}
    total, missing = len(seeds) * len(ranker.names()), sum(map(len, left.values()))
    what = f"ranking at {results.settings['task']}"
    with progress_bar(what, total, done=total - missing, shown=progress) as advance:
        for seed in (seed for seed, names in left.items() if names):
            results.add(*ranker.lines(seed, left[seed]))
            advance(len(left[seed]))
