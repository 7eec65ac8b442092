"""Plays the episodes of `acwm plan`, and writes videos and a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acwm_core.data.card import DatasetCard
from acwm_core.data.shards import file_sha256
from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import Environment, EnvironmentCard
from acwm_core.env.task import TaskEnvironment
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import duration
from acwm_core.plugins import catalog
from acwm_core.training.run import RunBundle, load_run, read_metadata
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_planning.controllers import (
    Controller,
    PlanningController,
    PolicyController,
    RandomController,
    StillController,
)
from acwm_planning.episode import (
    EpisodeResult,
    TaskVariant,
    load_task,
    play,
    spec_of_seed,
    start_of,
)
from acwm_planning.futures import ModelRollouts, reads_of
from acwm_planning.left_out import passed_over
from acwm_planning.planner import Cost, Planner
from acwm_planning.results import VIDEOS, PlanTable
from acwm_planning.resumable import Line, ResumableResults
from acwm_planning.runner import EpisodeTable, play_missing
from acwm_planning.settings import Settings
from acwm_planning.simulator import SimulatorRollouts
from acwm_planning.table import EpisodeLine, summarise, write_summary
from acwm_planning.video import draw_curves, imagine, write_episode

PLANNED_ROWS = ("model", "simulator", "codec")


class EpisodePlayer:
    """Plays episodes of a task with a model and settings, for any row of the table.

    Args:
        bundle: the loaded run.
        task: name of a task of its environment.
        settings: settings of planning.
        device: device of the model; ``"auto"`` takes a GPU if there is one.
        action_std: see `PlanningController`.

    Attributes:
        cost: the cost of the settings.

    Raises:
        RecipeError: the cost is of another environment.
    """

    def __init__(
        self,
        bundle: RunBundle,
        task: str,
        settings: Settings,
        device: str = "auto",
        action_std: Sequence[float] | None = None,
    ) -> None:
        self.card, self.settings, self._action_std = bundle.card, settings, action_std
        self._world = bundle.world_model.to(choose_device(device))
        goal_task = load_task(self.card.name, task)
        steps, limit = settings.goal_ahead, settings.max_steps
        if steps is not None or limit is not None:
            goal_task = TaskVariant(goal_task, steps=steps, max_steps=limit)
        self.environment = TaskEnvironment(self._make_environment(), goal_task)
        self._branches: Environment | None = None
        self.cost = make_cost(settings, self.card)
        self._estimator = estimator_for(self.card) if self.cost.observes else None

    def play(self, row: str, seed: int) -> tuple[EpisodeResult, Controller]:
        """Play one episode; returns it with the controller that acted."""
        controller = self.controller(row)
        return play(self.environment, spec_of_seed(self.card, seed), controller), controller

    def controller(self, row: str) -> Controller:
        """The controller of a row."""
        planner = make_planner(self.settings)
        if row == "still":
            return StillController()
        if row == "random":
            return RandomController(getattr(planner, "action_block", planner.actions_per_plan))
        if row in ("policy", "solution"):
            return PolicyController.scripted(solves=row == "solution")
        rollouts = self.rollouts() if row == "model" else self._simulator_rollouts(row == "codec")
        return PlanningController(planner, rollouts, self.cost, action_std=self._action_std)

    def rollouts(self) -> ModelRollouts:
        """The rollouts of the model."""
        parameters = self.settings.rollouts(self.cost)
        return ModelRollouts(self._world, self.card, self._estimator, **parameters)

    def seconds(self, row: str, seed: int) -> float:
        """How long an episode takes at most, from a first decision; 0 without a planner."""
        if row not in PLANNED_ROWS:
            return 0.0
        controller, spec = self.controller(row), spec_of_seed(self.card, seed)
        assert isinstance(controller, PlanningController)
        start = start_of(self.environment, spec)
        controller.begin(self.environment.environment, self.environment.task, start.goal)
        actions = controller.act(start.history)
        decisions = -(-self.environment.task.max_steps // len(actions))
        return decisions * controller.decisions[0].seconds

    def write_video(
        self, folder: Path, row: str, seed: int, result: EpisodeResult, controller: Controller
    ) -> None:
        """Write a video of what happened and, if the model planned, of what it imagined."""
        imagined = None
        if isinstance(controller, PlanningController) and isinstance(
            controller.rollouts, ModelRollouts
        ):
            imagined = imagine(result, controller.rollouts, controller.still)
        stride, task, fps = self._world.codec.temporal_stride, self.environment.task, self.card.fps
        estimator = estimator_for(self.card) if imagined is not None else None
        curves = draw_curves(row, seed, result, task, fps, imagined, estimator, stride)
        clip = None if imagined is None else imagined.clip
        write_episode(folder / f"{row}-{seed:04d}.mp4", result, curves, clip)

    def close(self) -> None:
        """Close the environments."""
        for environment in (self.environment, self._branches):
            if environment is not None:
                environment.close()

    def _simulator_rollouts(self, coded: bool) -> SimulatorRollouts:
        if self._branches is None:
            self._branches = self._make_environment()
        codec = self._world.codec
        estimator = self._estimator if coded else None
        reads = reads_of(self._world)
        return SimulatorRollouts(self._branches, codec.temporal_stride, codec, estimator, reads)

    def _make_environment(self) -> Environment:
        return make_environment(self.card.name, {"size": self.card.frame_size})


def make_planner(settings: Settings) -> Planner:
    """Create the planner of these settings."""
    return _create("planner", settings.planner, Planner)


def make_cost(settings: Settings, card: EnvironmentCard | None = None) -> Cost:
    """Create the cost of these settings.

    Raises:
        RecipeError: it is of another environment than that of the card.
    """
    cost: Cost = _create("cost", settings.cost, Cost)
    if card is not None:
        cost.check(card)
    return cost


def facts_of_cost(run: str | Path, settings: Settings) -> dict[str, str]:
    """What the cost of these settings depends on beside its parameters; see `Cost.about`."""
    card = DatasetCard.read(RunFolder(find_run(run)).card).environment
    return {**make_cost(settings, card).about()}


def _create(kind: Any, choice: Mapping[str, Any], base: type[Any]) -> Any:
    params = {name: value for name, value in choice.items() if name != "name"}
    return catalog().component(kind, choice["name"]).create_as(base, **params)


def declared_settings(run: str | Path, task: str) -> tuple[str, ...]:
    """The settings that a task of a run's environment declares; see `Task.planning`."""
    name = DatasetCard.read(RunFolder(find_run(run)).card).environment.name
    return load_task(name, task).planning


def action_std_of(run: Path) -> list[float] | None:
    """Standard deviation `[A]` of the raw actions that a model was trained on; None if unknown."""
    statistics = DatasetCard.read(RunFolder(run).card).actions.get("train")
    return None if statistics is None else [*statistics["std"]]


class PlannedEpisodes(EpisodeTable):
    """Episodes of a task, with a row for each way to act.

    Args:
        player: plays them.
        rows: of `ROW_NAMES`.
        videos: folder of the videos.
        video_seeds: seeds that get a video.
    """

    def __init__(
        self, player: EpisodePlayer, rows: Sequence[str], videos: Path, video_seeds: Sequence[int]
    ) -> None:
        super().__init__(rows)
        self._player, self._videos, self._video_seeds = player, videos, video_seeds

    def lines(self, seed: int, rows: Sequence[str]) -> Iterator[Line]:
        for row in rows:
            if row in self.left.rows or seed in self.left.solved:
                continue
            line: Line = {}
            with self.left.trying(row, seed):
                result, controller = self._player.play(row, seed)
                if seed in self._video_seeds:
                    self._player.write_video(self._videos, row, seed, result, controller)
                line = {"row": row, "seed": seed, **result.facts()}
            if line:
                yield line

    def estimate(self, missing: Mapping[int, Sequence[str]]) -> str:
        """Episodes that are solved end earlier, and those without a planner take little."""
        counts = Counter(row for rows in missing.values() for row in rows)
        if counts.total() < 2:
            return ""
        seconds = 0.0
        for row, count in counts.items():
            with passed_over():
                seconds += count * self._player.seconds(row, next(iter(missing)))
        return f"at most about {duration(seconds)} for {counts.total()} episodes" if seconds else ""


def plan_episodes(
    run: Path,
    task: str,
    settings: Settings,
    *,
    seeds: Sequence[int],
    rows: Sequence[str],
    out: Path,
    videos: int = 3,
    device: str = "auto",
    report: Callable[[Line], None] = lambda line: None,
    progress: bool = False,
) -> PlanTable:
    """Play the episodes that are missing in `out`, and write the table of all episodes.

    Args:
        run: the run folder.
        task: name of a task of its environment.
        settings: settings of planning.
        seeds: numbers of the episodes, the same for all rows.
        rows: rows of the table to play.
        out: the results folder. Episodes that it already holds are not played again.
        videos: number of seeds, from the first, that get a video.
        device: device of the model.
        report: called with the result of every episode, after the table is written.
        progress: show an estimate of the time, and a progress bar.

    Returns:
        The table of all episodes in `out`.
    """
    weights = RunFolder(run).weights
    player = EpisodePlayer(load_run(run), task, settings, device, action_std_of(run))
    goal_task, digest = player.environment.task, read_metadata(weights).get("sha256")
    identity = {"environment": player.card.name, "task": task, "weights": digest}
    # reports recognise the weights by the file's hash
    facts = {
        "unit": goal_task.unit,
        "tolerance": goal_task.tolerance,
        "file_sha256": file_sha256(weights),
    }
    identity |= settings.to_dict() | facts_of_cost(run, settings)
    results = ResumableResults(out, identity, kind=EpisodeLine)
    table = PlannedEpisodes(player, rows, out / VIDEOS, seeds[:videos])

    def write(line: Line | None = None) -> None:
        rows = [asdict(row) for row in summarise(results.finished())]
        write_summary(out, {**results.settings, **facts, **table.left.facts(), "rows": rows})
        if line is not None:
            report(line)

    label = f"planning {task}" if progress else ""
    try:
        with results.adding():
            play_missing(table, results, seeds, report=write, progress=label)
            write()
            return PlanTable.read(out)
    finally:
        player.close()
