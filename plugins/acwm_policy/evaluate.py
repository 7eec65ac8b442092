"""`evaluate_policy`: a trained policy in the simulator and in its dream, from the same starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from acwm_core.data.shards import file_sha256
from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import Environment, EnvironmentCard
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.results import write_json
from acwm_core.evaluation.statistics import PairedDifference, paired_bootstrap
from acwm_core.training.run import RunBundle, load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_core.training.threads import use_threads
from acwm_dream.starts import DreamStart
from acwm_planning.controllers import (
    Actions,
    Controller,
    PolicyController,
    RandomController,
    StillController,
)
from acwm_planning.episode import EpisodeResult, load_task, play, spec_of_seed, start_of
from acwm_planning.futures import History
from acwm_planning.left_out import LeftOut
from acwm_planning.policies.saved import POLICY_FILE, SavedPolicy, policy_for, raw_actions
from acwm_planning.results import VIDEOS
from acwm_planning.resumable import Line, ResumableResults
from acwm_planning.rewards.task import RewardTask
from acwm_planning.runner import EpisodeTable, play_missing
from acwm_planning.table import EpisodeLine, summarise
from acwm_policy.episodes import Episodes
from acwm_policy.scenes import DreamScenes
from acwm_policy.videos import write_video

EVALUATION, EVALUATION_FILE = "evaluation", "evaluation.json"
"""Folder of the results within a policy's folder, and the file with the summary."""

TRAINED, DREAM, BESIDE = "trained", "dream", "beside"
"""Rows of the policy in the simulator and in the model, and of another policy in the simulator."""

ROWS = (TRAINED, DREAM, BESIDE, "solution", "behaviour", "random", "still")
"""Rows of the table, the first one first."""


class StateController(Controller):
    """Lets a saved policy act on the simulator's own states, or on its frames.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: SavedPolicy) -> None:
        self._policy = policy

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """Start an episode."""
        self._environment = environment
        self._policy.reset(goal)

    def act(self, history: History) -> Actions:
        """The policy's action, held for a latent frame."""
        of_frames = self._policy.observes == "frame"
        seen = history.frames[-1] if of_frames else self._environment.observe_state()
        action = self._policy.predict(seen)
        return [action] * self._policy.card.repeat


class EvaluatedEpisodes(EpisodeTable):
    """Episodes of a policy and of what it is compared with, from the same starts.

    Args:
        policy: the policy.
        bundle: the model that it is dreamt in, on its device.
        environment: the simulator with the task.
        rows: of `ROWS`.
        beside: another policy for the same task, for the row of that name.
        videos: folder of the videos.
        filmed: seeds that get a video of the policy.
    """

    def __init__(
        self,
        policy: SavedPolicy,
        bundle: RunBundle,
        environment: TaskEnvironment,
        rows: Sequence[str],
        beside: SavedPolicy | None = None,
        videos: Path = Path(VIDEOS),
        filmed: Sequence[int] = (),
    ) -> None:
        super().__init__(rows)
        self._policy, self._bundle, self._environment = policy, bundle, environment
        self._videos, self._filmed = videos, filmed
        repeat = policy.card.repeat
        self._controllers = {
            TRAINED: StateController(policy),
            BESIDE: StateController(beside or policy),
            "solution": PolicyController.scripted(solves=True),
            "behaviour": PolicyController.scripted(solves=False),
            "random": RandomController(repeat),
            "still": StillController(),
        }

    def estimate(self, missing: Mapping[int, Sequence[str]]) -> str:
        """Episodes are short, so nothing is said of their time."""
        return ""

    def lines(self, seed: int, rows: Sequence[str]) -> list[Line]:
        """The episodes of a seed."""
        lines: list[Line] = []
        for row in rows:
            if row in self.left.rows or seed in self.left.solved:
                continue
            with self.left.trying(row, seed):
                lines.append({"row": row, "seed": seed, **self._facts(row, seed)})
        return lines

    def _facts(self, row: str, seed: int) -> dict[str, Any]:
        if row == DREAM:
            return self._dream(seed)[0].facts
        spec = spec_of_seed(self._bundle.card, seed)
        result = play(self._environment, spec, self._controllers[row])
        if row == TRAINED and seed in self._filmed:
            self._film(seed, result)
        return result.facts()

    def _dream(self, seed: int) -> tuple[Dreamt, DreamStart]:
        spec, given = spec_of_seed(self._bundle.card, seed), self._bundle.world_model.context_frames
        start = start_of(self._environment, spec, given=given)
        actions = np.array(start.history.actions, np.float32)
        actions = actions.reshape(given - 1, self._bundle.card.action.size)
        begun = DreamStart(np.stack(start.history.frames), actions, start.goal)
        return dream(self._policy, self._bundle, self._environment.task, begun), begun

    def _film(self, seed: int, result: EpisodeResult) -> None:
        path = self._videos / f"{TRAINED}-{seed:04d}.mp4"
        start, decided = None, list[Tensor]()
        if DREAM in self.rows:
            dreamt, start = self._dream(seed)
            decided = dreamt.decided
        parts = self._bundle, self._environment.task, start, decided
        write_video(path, TRAINED, seed, result, *parts)


class Dreamt(NamedTuple):
    """An episode in a model: its facts, as of one in the simulator, and the raw actions `[A]`."""

    facts: dict[str, Any]
    decided: list[Tensor]


def dream(policy: SavedPolicy, bundle: RunBundle, task: Task, start: DreamStart) -> Dreamt:
    """An episode of the policy in the model."""
    scenes = DreamScenes(bundle.world_model, [start], 1)
    episodes = Episodes(scenes, task, bundle.card, policy.card.inputs, unit=1.0, bonus=0.0)
    vectors, next_ones, taken = episodes.begin([0]), list[Tensor](), list[Tensor]()
    begun = float(episodes.distances[0])
    for _ in range(-(-task.max_steps // scenes.repeat)):
        next_ones = next_ones or [*policy.scaled(vectors).unbind(1)]
        taken.append(raw_actions(next_ones[0][0], bundle.card.action.low, bundle.card.action.high))
        step = episodes.step(next_ones.pop(0))
        vectors = step.vectors
        if step.over[0]:
            facts: dict[str, Any] = {
                "success": bool(step.solved[0]),
                "failed": bool(step.failed[0]),
                "steps": int(step.frames[0]),
                "start_distance": begun,
                "distance": begun - float(step.returns[0]),
            }
            return Dreamt(facts, taken)
    raise RecipeError(f"the task {task.name!r} does not end")


def evaluate_policy(
    folder: Path,
    *,
    seeds: Sequence[int],
    run: str | Path | None = None,
    beside: Path | None = None,
    rows: Sequence[str] = ROWS,
    videos: int = 0,
    out: Path | None = None,
    device: str = "auto",
    progress: bool = False,
) -> dict[str, Any]:
    """Play what is missing, and write the table of all episodes.

    Args:
        folder: the policy's folder.
        seeds: numbers of episodes of the test split, the same for all rows.
        run: the model to dream in; by default the one that the policy was trained with.
        beside: folder of another policy for the same task, to compare with.
        rows: those of `ROWS` to play.
        videos: number of seeds, from the first, of which a video of the policy is written.
        out: folder of the results; `EVALUATION` within `folder` by default.
        device: device of the model.
        progress: show a progress bar.

    Returns:
        What it writes into `EVALUATION_FILE`.

    Raises:
        DataError: there is no policy, or no model; or `out` holds results of another policy.
    """
    policy, where = SavedPolicy.read(folder), out or folder / EVALUATION
    if not policy.card.task and "reward" not in policy.card.training:
        raise RecipeError(
            f"{folder} was trained without a task, so the simulator cannot judge it; curve.csv in "
            "it has its error on held-out recordings"
        )
    use_threads(None, None, choose=True)
    model = run or policy.card.training.get("model", policy.card.environment)
    bundle = load_run(model)
    if bundle.card.name != policy.card.environment:
        raise RecipeError(
            f"the policy acts in {policy.card.environment}, but {model} is a model of "
            f"{bundle.card.name}"
        )
    bundle.world_model.to(choose_device(device))
    task = task_of(policy, bundle.card)
    identity = {
        "environment": bundle.card.name,
        "task": task.name,
        "policy": file_sha256(folder / POLICY_FILE),
        "weights": file_sha256(RunFolder(find_run(model)).weights),
    }
    if isinstance(task, RewardTask):
        identity["reward"] = task.facts()["sha256"]
    other = None
    if beside is not None:
        other = policy_for(str(beside), bundle.card, task.name)
        identity["beside"] = file_sha256(beside / POLICY_FILE)
    inner = make_environment(bundle.card.name, {"size": bundle.card.frame_size})
    with closing(inner):
        environment = TaskEnvironment(inner, task)
        without = {DREAM} if not dreams(bundle, policy) else set[str]()
        without |= {BESIDE} if other is None else set()
        played = [row for row in ROWS if row in rows and row not in without]
        films = where / VIDEOS, seeds[:videos]
        table = EvaluatedEpisodes(policy, bundle, environment, played, other, *films)
        results = ResumableResults(where, identity, kind=EpisodeLine)
        with results.adding():
            label = f"evaluating at {task.name}" if progress else ""
            play_missing(table, results, seeds, progress=label)
            summary = _summary(results, task, policy, table.left)
            write_json(where / EVALUATION_FILE, summary)
    return summary


def _summary(
    results: ResumableResults,
    task: Task,
    policy: SavedPolicy,
    left: LeftOut,
) -> dict[str, Any]:
    lines = results.finished()
    return {
        **results.settings,
        **({"held_out": task.facts()["held_out"]} if isinstance(task, RewardTask) else {}),
        "unit": task.unit,
        "tolerance": task.tolerance,
        **left.facts(),
        "rows": [asdict(row) for row in summarise(lines, ROWS)],
        "gap": asdict(gap_of(lines)) if any(line["row"] == DREAM for line in lines) else None,
        "dream_alone": solved_in_dream_alone(lines),
        "training": policy.card.training,
    }


def solved_in_dream_alone(lines: Sequence[Line]) -> list[int]:
    """Seeds of the episodes that the policy solves in the dream and not in the simulator."""
    won = {(line["row"], line["seed"]): line["success"] for line in lines}
    return sorted(
        seed
        for row, seed in won
        if row == TRAINED and won.get((DREAM, seed)) and not won[row, seed]
    )


def task_of(policy: SavedPolicy, card: EnvironmentCard) -> Task:
    """What a policy was trained for: a task, or a reward in place of one.

    Raises:
        DataError: the reward is not there, or another one by now.
        RecipeError: it was trained for neither.
    """
    about = policy.card.training.get("reward")
    if about is None:
        return load_task(card.name, policy.card.task)
    task = RewardTask.read(about["head"], card)
    if task.facts()["sha256"] != about["sha256"]:
        raise DataError(f"{about['head']} is not the reward that the policy was trained for")
    return task


def dreams(bundle: RunBundle, policy: SavedPolicy) -> bool:
    """Whether a model predicts what a policy observes, at the rate at which it decides."""
    shapes, rate = bundle.world_model.state_shapes, bundle.world_model.codec.temporal_stride
    predicted = policy.observes == "state" and {*policy.card.inputs.state} <= {*shapes}
    return predicted and policy.card.repeat == rate


def gap_of(lines: Sequence[Line]) -> PairedDifference:
    """By how much success in the dream exceeds that in the simulator, on the episodes of both."""
    won = {(line["row"], line["seed"]): float(line["success"]) for line in lines}
    seeds = [seed for row, seed in won if row == TRAINED and (DREAM, seed) in won]
    return paired_bootstrap([won[DREAM, seed] - won[TRAINED, seed] for seed in seeds] or [0.0])
