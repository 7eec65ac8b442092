"""`train_policy`: learns in the dream or the simulator, and goes on where it was killed."""

from __future__ import annotations

import copy
import csv
import io
import json
import math
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.executors import progress_bar
from acwm_core.files import held, load_plain, read_json, writing, written_whole
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_core.training.threads import use_threads
from acwm_planning.policies.networks import layers_of
from acwm_planning.policies.saved import POLICY_FILE, PolicyCard, PolicyInputs, SavedPolicy
from acwm_planning.rewards.task import RewardTask
from acwm_policy.learner import Learner
from acwm_policy.lesson import (
    Lesson,
    Measured,
    Place,
    beginnings,
    find_reward,
    find_task,
    imitate,
    prepare,
)
from acwm_policy.settings import PolicySettings, learner_class

SETTINGS_FILE, CHECKPOINT, CURVE = "settings.json", "checkpoint.pt", "curve.csv"
"""Files in a policy's folder, beside the policy."""

CHECKPOINTS = 20
"""Most stages of a training; each ends with a checkpoint."""

VERSION = 1
"""Of the contents of a checkpoint."""

PLACES: Mapping[Place, str] = {
    "dream": "in the dream",
    "simulator": "in the simulator",
    "recordings": "from recordings",
}
"""Phrases for where a policy learns."""

COLUMNS = ("steps", "success", "return", "error", "cpu_seconds")
"""Columns of the curve: steps, success and return of the last episodes where the policy is trained,
or its error on held-out recordings, and the seconds of processor time that training has taken."""


def train_policy(
    run: str | Path,
    task: str,
    *,
    settings: PolicySettings,
    out: Path,
    place: Place | None = None,
    steps: int | None = None,
    scenes: int | None = None,
    starts: int = 256,
    data: Path | None = None,
    reward: Path | None = None,
    after: Path | None = None,
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
        place: whether to act in the dream of the model or in the simulator; by default the
            learner's first.
        steps: steps of all scenes together; a step holds an action for one latent frame. By
            default the learner's.
        scenes: number of scenes side by side; by default 64 in the dream and 1 in the simulator.
        starts: number of training episodes whose starts are used.
        data: dataset to take the starts from instead of the simulator, or to imitate.
        reward: folder of a reward head, to maximise in place of a task; `task` is the environment.
        after: folder of a policy to begin with, which the same learner has trained, for example in
            an earlier model; its steps count. Its scale of observations stays, as its network knows
            no other; what passed in a dream of another model is forgotten.
        seed: of the starts, the network and the exploration.
        device: device of the model.
        progress: show a progress bar.

    Raises:
        DataError: `out` holds a policy that was trained otherwise.
        RecipeError: the model predicts too little for the task, or a parameter is wrong.
    """
    place = _place_of(settings, place)
    steps = learner_class(settings.algorithm).usual_steps if steps is None else steps
    if place == "recordings":
        if reward is not None:
            raise RecipeError(f"{settings.algorithm} imitates recordings, and maximises no reward")
        return _imitate(task, settings, out, steps, data, seed, progress)
    if ("." in task) == (reward is not None):
        raise RecipeError(
            f"{task}: give ENVIRONMENT.TASK, such as reacher.reach, or ENVIRONMENT and --reward"
        )
    number = scenes or (64 if place == "dream" else 1)
    bundle, weights = load_run(run), RunFolder(find_run(run)).weights
    asked = find_task(task, bundle.card) if reward is None else find_reward(task, reward, bundle)
    about = {
        "environment": bundle.card.name,
        "task": asked.name if reward is None else "",
        "model": str(run),
        "weights": file_sha256(weights),
        "place": place,
        "scenes": number,
        "starts": starts,
        "data": None if data is None else str(data),
        "after": None if after is None else file_sha256(after / POLICY_FILE),
        "seed": seed,
        **asdict(settings),
        **({"reward": asked.facts()} if isinstance(asked, RewardTask) else {}),
    }
    with _opened(out, about):
        use_threads(None, None, choose=True)
        bundle.world_model.to(choose_device(device))
        stored, other = load_checkpoint(out / CHECKPOINT), False
        if stored is None and after is not None:
            stored = load_checkpoint(after / CHECKPOINT)
            learnt = SavedPolicy.read(after).card.training
            other = place == "dream" and learnt.get("weights") != about["weights"]
        begun = beginnings(bundle, asked, starts, data, place, progress)
        lesson = prepare(
            *(bundle, asked, begun, place, number),
            observe=settings.observe,
            bonus=settings.bonus,
            seed=seed,
            measured=None if stored is None else measured_in(stored),
        )
        with closing(lesson.source):
            return _learn(lesson, settings, about, out, steps, stored, progress, other)


def _place_of(settings: PolicySettings, place: Place | None) -> Place:
    """What a policy is to learn from; the learner's usual place by default."""
    places = learner_class(settings.algorithm).places
    if place is not None and place not in places:
        known = " or ".join(PLACES[choice] for choice in places)
        raise RecipeError(f"{settings.algorithm} learns {known}, not {PLACES[place]}")
    return place or places[0]


def _imitate(
    name: str,
    settings: PolicySettings,
    out: Path,
    steps: int,
    data: Path | None,
    seed: int,
    progress: bool,
) -> SavedPolicy:
    if data is None:
        raise RecipeError(f"{settings.algorithm} imitates recordings: name a dataset with --data")
    learner = settings.learner()
    about = {
        "environment": name.partition(".")[0],
        "task": name.partition(".")[2],
        "place": "recordings",
        "data": str(data),
        "identity": EpisodeDataset(data, "train").checksum,
        "seed": seed,
        **asdict(settings),
    }
    with _opened(out, about):
        use_threads(None, None, choose=True)
        how = learner.hold, learner.chunk, learner.picture
        lesson = imitate(data, name, settings.observe, *how)
        stored = load_checkpoint(out / CHECKPOINT)
        return _learn(lesson, settings, about, out, steps, stored, progress)


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
    stored: Mapping[str, Any] | None,
    progress: bool,
    other: bool = False,
) -> SavedPolicy:
    learner = settings.learner()
    learner.begin(lesson, about["seed"])
    keeper = _Keeper(learner, lesson, about, out)
    if stored is not None:
        keeper.restore(stored)
    if other:
        learner.forget()
    shown = progress_bar(
        f"{about['algorithm']} at {lesson.task or lesson.card.name} {PLACES[lesson.place]}",
        steps,
        unit="steps",
        done=learner.steps,
        shown=progress and learner.steps < steps,
        note=keeper.note,
    )
    every = max(lesson.source.shortest, steps // CHECKPOINTS)
    with shown as report:
        while learner.steps < steps:
            learner.learn(min(steps, (learner.steps // every + 1) * every), report)
            keeper.save()
    return SavedPolicy.read(out)


class _Keeper:
    """Writes checkpoints, the policy and its curve between the stages of learning."""

    def __init__(
        self, learner: Learner, lesson: Lesson, about: Mapping[str, Any], out: Path
    ) -> None:
        self._learner, self._lesson, self._about, self._out = learner, lesson, about, out
        self._began, self._seconds = time.process_time(), 0.0
        self._rows: list[list[float | None]] = []

    def note(self) -> str:
        """How the policy does where it learns."""
        return self._lesson.source.note()

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._learner.restore(stored["learner"])
        self._lesson.source.restore(stored["source"])
        self._rows, self._seconds = [*stored["curve"]], stored["seconds"]

    def save(self) -> None:
        """Write everything; a killed command goes on from here.

        Of recordings, the policy of the lowest error on those that are held out is kept.
        """
        now = time.process_time()
        self._seconds, self._began = self._seconds + now - self._began, now
        score = self._lesson.source.score(self._learner.network())
        values = [score.get(name) for name in COLUMNS[1:-1]]
        errors = [row[COLUMNS.index("error")] for row in self._rows]
        self._rows.append([self._learner.steps, *values, round(self._seconds, 1)])
        if score.get("error", 0.0) <= min((e for e in errors if e is not None), default=math.inf):
            self._policy().save(self._out)  # few recordings are soon overfitted
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *self._rows])
        with written_whole(self._out / CURVE) as partial:
            partial.write_text(text.getvalue(), encoding="utf-8")
        inputs, unit = self._lesson.measured
        whole = {
            "version": VERSION,
            "learner": self._learner.state(),
            "source": self._lesson.source.state(),
            "inputs": asdict(inputs),
            "unit": unit,
            "curve": self._rows,
            "seconds": self._seconds,
        }
        with written_whole(self._out / CHECKPOINT) as partial:
            torch.save(whole, partial)

    def _policy(self) -> SavedPolicy:
        lesson, card = self._lesson, self._lesson.card
        network = copy.deepcopy(self._learner.network())
        facts: dict[str, Any] = {
            "steps": self._learner.steps,
            "cpu_seconds": round(self._seconds, 1),
        }
        layers = layers_of(network)
        network_size = next(size for size in reversed(layers) if isinstance(size, int))
        about = PolicyCard(
            environment=card.name,
            task=str(self._about["task"]),
            repeat=lesson.repeat,
            low=[*map(float, card.action.low)],
            high=[*map(float, card.action.high)],
            inputs=lesson.measured.inputs,
            layers=layers,
            training={**self._about, **facts, **lesson.source.score(network)},
            chunk=network_size // card.action.size,
        )
        return SavedPolicy(about, network)


def measured_in(stored: Mapping[str, Any]) -> Measured:
    """What a checkpoint says of observations."""
    return Measured(PolicyInputs(**stored["inputs"]), stored["unit"])


def load_checkpoint(path: Path) -> dict[str, Any] | None:
    """The contents of a checkpoint, if there is one; nothing in it is run.

    Raises:
        DataError: it is damaged, or of another version.
    """
    if not path.exists():
        return None
    content: Any = load_plain(path)
    if not isinstance(content, dict) or content.get("version") != VERSION:  # pyright: ignore
        raise DataError(f"{path} is no checkpoint of this version: delete it to begin anew")
    return cast(dict[str, Any], content)
