"""`improve_policy`: collect with a policy, train the model and the policy further, and measure."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import file_sha256
from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import RecipeError
from acwm_core.evaluation.statistics import Estimate
from acwm_core.files import written_whole
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import with_overrides
from acwm_core.training.fit import fit
from acwm_core.training.resume import AUTO
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_planning.resumable import Line, ResumableResults
from acwm_policy.collect import Collection, collect
from acwm_policy.evaluate import DREAM, ROWS, TRAINED, evaluate_policy
from acwm_policy.lesson import Place, find_task
from acwm_policy.settings import PolicySettings, learner_class
from acwm_policy.train import train_policy

ROUNDS, TABLE = "rounds.jsonl", "rounds.csv"
"""Files with a line for each finished round."""

DATA, MODEL, POLICY = "data", "model", "policy"
"""Folders: the data of all rounds, and in the folder of a round its model and its policy."""


@dataclass(frozen=True)
class Round:
    """A finished round.

    Attributes:
        task: ENVIRONMENT.TASK.
        round: its number; in round 0 nothing has been collected, and the model is the given one.
        frames: number of frames that were simulated for training so far.
        steps: number of steps that the policy has learnt for so far.
        episodes: number of episodes that were measured, the same ones in every round.
        dream: share of success in the model, with its exact 95 % interval; None if the model does
            not predict what the policy observes, or the policy learns in the simulator.
        simulator: the same in the simulator.
        gap: the first minus the second, with its bootstrap interval.
        distance: mean final distance in the simulator.
    """

    task: str
    round: int
    frames: int
    steps: int
    episodes: int
    dream: Estimate | None
    simulator: Estimate
    gap: Estimate | None
    distance: float


@dataclass(frozen=True)
class Loop:
    """What is the same in every round; see `improve_policy`."""

    run: str
    task: str
    card: EnvironmentCard
    settings: PolicySettings
    recipe: tuple[str, ...]
    out: Path
    episodes: int
    noise: float
    steps: int
    seeds: tuple[int, ...]
    scenes: int | None
    starts: int
    data: Path | None
    seed: int
    place: Place

    def identity(self) -> dict[str, Any]:
        """All that determines the results, to write down."""
        facts = {field.name: getattr(self, field.name) for field in fields(self)}
        del facts["card"], facts["out"]
        if self.place == "dream":
            del facts["place"]
        base = self.data and EpisodeDataset(self.data, "train").checksum
        weights = file_sha256(RunFolder(find_run(self.run)).weights)
        settings = asdict(self.settings)
        return {**facts, "settings": settings, "data": base, "weights": weights}

    def folder(self, number: int) -> Path:
        """The folder of a round."""
        return self.out / f"round-{number}"

    def play(self, number: int, workers: int | None, device: str, progress: bool) -> Round:
        """One round: data, model, policy, measurement; each goes on where it was interrupted."""
        here, run, frames, dreamt = self.folder(number), self.run, 0, self.place == "dream"
        if number and dreamt:
            frames = self.collect(number, workers, progress)
            run = str(self.train_model(number))
        policy = train_policy(
            *(run, self.task),
            settings=self.settings,
            out=here / POLICY,
            place=self.place,
            steps=self.steps * (number + 1),
            scenes=self.scenes,
            starts=self.starts,
            after=self.folder(number - 1) / POLICY if number else None,
            seed=self.seed,
            device=device,
            progress=progress,
        )
        rows = (TRAINED, DREAM) if number else ROWS
        found = evaluate_policy(
            here / POLICY,
            seeds=self.seeds,
            run=run,
            rows=[row for row in rows if dreamt or row != DREAM],
            device=device,
            progress=progress,
        )
        steps = policy.card.training["steps"]
        frames = frames if dreamt else steps * policy.card.repeat
        return _measured(found, self.task, number, frames, steps)

    def collect(self, number: int, workers: int | None, progress: bool) -> int:
        """Let the policies before this round act; how many frames were simulated so far."""
        policies = tuple(self.folder(earlier) / POLICY for earlier in range(number))
        collection = Collection(
            self.card, policies, self.episodes, self.noise, self.seed, self.data
        )
        collect(collection, self.out / DATA, workers=workers, progress=progress)
        lengths = EpisodeDataset(self.out / DATA, "train").lengths
        return sum(lengths[collection.first if self.data else 0 :])

    def train_model(self, number: int) -> Path:
        """Train the model of the round before further, on all data."""
        before = str(self.folder(number - 1) / MODEL) if number > 1 else self.run
        given = Recipe.from_yaml(RunFolder(find_run(before)).recipe).to_dict()
        sections = with_overrides(given, self.recipe)
        sections["data"] |= {"path": str(self.out / DATA), "growing": False}
        sections["training"] |= {"init_from": before, "ignore_mismatched_sizes": False}
        sections["trainer"] |= {"devices": 1, "strategy": "auto"}
        sections["trainer"].pop("num_nodes", None)
        return fit(Recipe.from_dict(sections), self.folder(number) / MODEL, resume=AUTO)


def improve_policy(
    run: str | Path,
    task: str,
    *,
    settings: PolicySettings,
    out: Path,
    rounds: int,
    seeds: Sequence[int],
    recipe: Sequence[str] = (),
    episodes: int = 32,
    noise: float = 0.2,
    steps: int | None = None,
    scenes: int | None = None,
    starts: int = 256,
    data: Path | None = None,
    workers: int | None = None,
    seed: int = 0,
    place: Place = "dream",
    device: str = "auto",
    report: Callable[[Sequence[Line]], object] = lambda lines: None,
    progress: bool = False,
) -> list[Line]:
    """Play the rounds that are missing in `out`; see `Round` for what is written of each.

    In round 0 a policy learns in the given model. In every other one the last policy collects
    episodes in the simulator, the last model is trained further on all data, and the policy learns
    further in it. A call that was killed goes on where it was.

    Args:
        run: run folder, or name of a trained model.
        task: ENVIRONMENT.TASK, or the task's name.
        settings: the algorithm and its parameters.
        out: the folder of everything.
        rounds: number of rounds after round 0.
        seeds: episodes of the test split to measure on, the same in every round.
        recipe: overrides of the model's recipe, such as ``trainer.max_steps=400``.
        episodes: number of episodes to collect in a round.
        noise: see `Collection`.
        steps: steps that the policy learns for in a round; by default the learner's usual number.
        scenes: see `train_policy`.
        starts: see `train_policy`.
        data: see `Collection.base`.
        workers: processes that simulate; one per core by default.
        seed: of the policy, and of the episodes without `data`.
        place: "simulator" lets the policy learn there, without data and without another model: what
            to compare with.
        device: device of the model.
        report: is called with the lines of all rounds after each of them.
        progress: show progress bars.

    Raises:
        DataError: `out` holds results of other settings.
        RecipeError: the learner learns from recordings, or an option is out of range.
    """
    kind = learner_class(settings.algorithm)
    if place == "dream" and place not in kind.places:
        raise RecipeError(
            f"{settings.algorithm} does not learn in a dream, and so nothing of a better model: "
            "choose another algorithm (`acwm list learner`)"
        )
    if not 0 <= noise <= 1 or episodes < 1:
        raise RecipeError("give a noise from 0 to 1, and one or more episodes for each round")
    card = DatasetCard.read(RunFolder(find_run(run)).card).environment
    loop = Loop(
        *(str(run), f"{card.name}.{find_task(task, card).name}", card),
        *(settings, tuple(recipe), out),
        *(episodes, noise, steps or kind.usual_steps, tuple(seeds), scenes, starts, data, seed),
        place,
    )
    results = ResumableResults(
        out, loop.identity(), keys=("task", "round"), kind=Round, file=ROUNDS
    )
    with results.adding():
        for number in range(rounds + 1):
            if number not in {line["round"] for line in results.finished()}:
                results.add(asdict(loop.play(number, workers, device, progress)))
            write_table(out / TABLE, results.finished())
            report(results.finished())
    return results.finished()


def write_table(path: Path, lines: Sequence[Line]) -> None:
    """Write rounds as CSV, the ends of intervals in columns of their own."""
    rows = [_flat(line) for line in lines]
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    with written_whole(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")


def _flat(line: Line) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for name, value in line.items():
        if name not in ("dream", "simulator", "gap"):
            row[name] = value
            continue
        for end, key in (("", "value"), ("_low", "low"), ("_high", "high")):
            row[name + end] = None if value is None else value[key]
    return row


def _measured(found: Mapping[str, Any], task: str, number: int, frames: int, steps: int) -> Round:
    """What an evaluation says of a round."""
    rows, gap = {row["row"]: row for row in found["rows"]}, found["gap"]
    trained = rows[TRAINED]
    return Round(
        *(task, number, frames, steps, trained["episodes"]),
        dream=Estimate(**rows[DREAM]["success"]) if DREAM in rows else None,
        simulator=Estimate(**trained["success"]),
        gap=None if gap is None else Estimate(gap["mean"], gap["low"], gap["high"]),
        distance=trained["distance"]["value"],
    )
