"""`train_policy`: learns in the dream or the simulator, and goes on where it was killed."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.executors import progress_bar
from acwm_core.files import held, read_json, writing, written_whole
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_core.training.threads import use_threads
from acwm_planning.policies.saved import PolicyCard, PolicyInputs, SavedPolicy
from acwm_policy.learner import (
    load_checkpoint,
    make_learner,
    network_in,
    restore,
    save_checkpoint,
)
from acwm_policy.lesson import Lesson, Place, beginnings, find_task, prepare
from acwm_policy.settings import PolicySettings
from acwm_policy.vector import TaskScenes

SETTINGS_FILE, CHECKPOINT, CURVE = "settings.json", "checkpoint.pt", "curve.csv"
"""Files in a policy's folder, beside the policy."""

CHECKPOINTS = 20
"""How many checkpoints a training writes, at equal distances."""

COLUMNS = ("steps", "success", "return", "cpu_seconds")
"""Columns of the curve: steps of all scenes together, success and return of the last episodes where
the policy is trained, and the seconds of processor time that training has taken."""


def train_policy(
    run: str | Path,
    task: str,
    *,
    settings: PolicySettings,
    out: Path,
    place: Place = "dream",
    steps: int = 200_000,
    scenes: int | None = None,
    starts: int = 256,
    data: Path | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: bool = False,
) -> SavedPolicy:
    """Train a policy, or go on with one that `out` holds, until it has taken so many steps.

    Args:
        run: run folder, or name of a trained model.
        task: name of a task of its environment, alone or after the environment's and a dot.
        settings: the algorithm and its parameters.
        out: the policy's folder.
        place: whether to act in the dream of the model or in the simulator.
        steps: steps of all scenes together; a step holds an action for one latent frame.
        scenes: number of scenes side by side; by default 64 in the dream and 1 in the simulator.
        starts: number of training episodes whose starts are used.
        data: dataset to take the starts from instead of the simulator.
        seed: of the starts, the network and the exploration.
        device: device of the model.
        progress: show a progress bar.

    Raises:
        DataError: `out` holds a policy that was trained otherwise.
        RecipeError: the model predicts too little for the task, or a parameter is wrong.
    """
    number = scenes or (64 if place == "dream" else 1)
    bundle, weights = load_run(run), RunFolder(find_run(run)).weights
    goal_task = find_task(task, bundle.card)
    about = {
        "environment": bundle.card.name,
        "task": goal_task.name,
        "model": str(run),
        "weights": file_sha256(weights),
        "place": place,
        "scenes": number,
        "starts": starts,
        "data": None if data is None else str(data),
        "seed": seed,
        **asdict(settings),
    }
    with _opened(out, about):
        use_threads(None, None, choose=True)
        bundle.world_model.to(choose_device(device))
        begun = beginnings(bundle, goal_task, starts, data, place)
        lesson = prepare(bundle, goal_task, begun, place, number, settings.observe, seed)
        with closing(lesson.scenes):
            return _learn(lesson, settings, about, out, steps, seed, progress)


def _opened(out: Path, about: Mapping[str, Any]) -> Any:
    """The folder, held against other commands.

    Raises:
        DataError: it holds a policy that was trained otherwise.
    """
    described, path = json.loads(json.dumps(about)), out / SETTINGS_FILE
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    if path.exists() and (out / CHECKPOINT).exists():
        stored = read_json(path, dict[str, Any], "settings of a policy")
        others = sorted(name for name in described if stored.get(name) != described[name])
        if others:
            raise DataError(
                f"{out} holds a policy with another {', '.join(others)}: choose another --out, or "
                "delete it"
            )
    else:
        with written_whole(path) as partial:
            partial.write_text(json.dumps(described, indent=1), encoding="utf-8")
    return held(out)


def _learn(
    lesson: Lesson,
    settings: PolicySettings,
    about: Mapping[str, Any],
    out: Path,
    steps: int,
    seed: int,
    progress: bool,
) -> SavedPolicy:
    path = out / CHECKPOINT
    whole = load_checkpoint(path) if path.exists() else None
    if whole is not None:
        lesson = lesson._replace(inputs=PolicyInputs(**whole["inputs"]), unit=whole["unit"])
    vector = TaskScenes(
        lesson.scenes,
        lesson.task,
        lesson.card,
        lesson.inputs,
        unit=lesson.unit,
        bonus=settings.bonus,
        seed=seed,
    )
    learner = make_learner(settings, vector, seed)
    keeper = _Keeper(lesson, vector, about, out, steps)
    if whole is not None:
        restore(learner, vector, whole)
        keeper.rows, keeper.seconds = [*whole["curve"]], whole["seconds"]
    left, label = steps - learner.num_timesteps, f"{about['algorithm']} at {lesson.task.name}"
    if left > 0:
        shown = progress_bar(
            f"{label} in the {about['place']}",
            steps,
            unit="steps",
            done=learner.num_timesteps,
            shown=progress,
            note=keeper.note,
        )
        with shown as keeper.report:
            learner.learn(left, callback=keeper, reset_num_timesteps=False)
        keeper.save()
    return SavedPolicy.read(out)


class _Keeper(BaseCallback):
    """Writes checkpoints, the policy and its curve while it learns, and reports progress."""

    def __init__(
        self, lesson: Lesson, scenes: TaskScenes, about: Mapping[str, Any], out: Path, steps: int
    ) -> None:
        super().__init__()
        self._lesson, self._scenes, self._about, self._out = lesson, scenes, about, out
        self._every, self._began = max(1, steps // CHECKPOINTS), time.process_time()
        self._reported = self._saved = 0
        self.rows: list[list[float | None]] = []
        self.seconds = 0.0
        self.report: Callable[[int], object] = lambda _: None

    def _on_training_start(self) -> None:
        self._reported = self._saved = self.num_timesteps = self.model.num_timesteps
        self._began = time.process_time()

    def _on_step(self) -> bool:
        self.report(self.num_timesteps - self._reported)
        self._reported = self.num_timesteps
        if self.num_timesteps - self._saved >= self._every:
            self.save()
        return True

    def note(self) -> str:
        """How many of the last episodes succeeded."""
        success = self._mean(self.model.ep_success_buffer) if hasattr(self, "model") else None
        return "" if success is None else f"{success:.0%} solved"

    def save(self) -> None:
        """Write everything; a killed command goes on from here."""
        self._saved = self.num_timesteps
        now = time.process_time()
        self.seconds, self._began = self.seconds + now - self._began, now
        returns = [each["r"] for each in self.model.ep_info_buffer or ()]
        success = self._mean(self.model.ep_success_buffer)
        self.rows = [row for row in self.rows if row[0] != self.num_timesteps]
        self.rows.append([self.num_timesteps, success, self._mean(returns), round(self.seconds, 1)])
        save_checkpoint(
            self._out / CHECKPOINT,
            self.model,
            self._scenes,
            inputs=asdict(self._lesson.inputs),
            unit=self._lesson.unit,
            curve=self.rows,
            seconds=self.seconds,
        )
        self._policy().save(self._out)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *self.rows])
        with written_whole(self._out / CURVE) as partial:
            partial.write_text(text.getvalue(), encoding="utf-8")

    def _policy(self) -> SavedPolicy:
        card, (layers, network) = self._lesson.card, network_in(self.model)
        facts = {"steps": self.num_timesteps, "cpu_seconds": round(self.seconds, 1)}
        about = PolicyCard(
            environment=card.name,
            task=self._lesson.task.name,
            repeat=self._lesson.scenes.repeat,
            low=[*map(float, card.action.low)],
            high=[*map(float, card.action.high)],
            inputs=self._lesson.inputs,
            layers=layers,
            training={**self._about, **facts},
        )
        return SavedPolicy(about, network)

    @staticmethod
    def _mean(values: Sequence[float] | None) -> float | None:
        return float(np.mean(values)) if values else None
