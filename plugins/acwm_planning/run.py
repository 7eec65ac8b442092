"""Plays the episodes of a run and a task, and writes videos and a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acwm_core.data.card import DatasetCard
from acwm_core.data.shards import file_sha256
from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import Environment
from acwm_core.env.task import Task, TaskEnvironment
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.score import estimator_for
from acwm_core.executors import duration
from acwm_core.plugins import catalog
from acwm_core.training.run import RunBundle, load_run, read_metadata
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_planning.controllers import (
    Controller,
    PlanningController,
    RandomController,
    ScriptedController,
    StillController,
)
from acwm_planning.episode import EpisodeResult, TaskVariant, play, spec_of_seed
from acwm_planning.futures import History, ModelRollouts
from acwm_planning.left_out import LeftOut, passed_over
from acwm_planning.page import write_page
from acwm_planning.planner import Cost, Planner
from acwm_planning.resumable import Line, ResumableResults
from acwm_planning.settings import Settings
from acwm_planning.simulator import SimulatorRollouts
from acwm_planning.table import (
    VIDEOS,
    EpisodeLine,
    RowSummary,
    missing_episodes,
    summarise,
    write_summary,
)
from acwm_planning.video import draw_curves, imagine, write_episode

PLANNED_ROWS = ("model", "simulator", "codec")


class EpisodePlayer:
    """Plays episodes of a task with a model and settings, for any row of the table.

    Args:
        bundle: the loaded run.
        task: name of a task of its environment.
        settings: settings of planning.
        device: device of the model; ``"auto"`` takes a GPU if there is one.
        usual: see `PlanningController`.
    """

    def __init__(
        self,
        bundle: RunBundle,
        task: str,
        settings: Settings,
        device: str = "auto",
        usual: Sequence[float] | None = None,
    ) -> None:
        self.card, self.settings, self._usual = bundle.card, settings, usual
        self._world = bundle.world_model.to(choose_device(device))
        component = catalog().component("environment", self.card.name)
        goal_task: Task = component.load_task(task)
        steps, limit = settings.goal_ahead, settings.max_steps
        if steps is not None or limit is not None:
            goal_task = TaskVariant(goal_task, steps=steps, max_steps=limit)
        self.environment = TaskEnvironment(self._make_environment(), goal_task)
        self._branches: Environment | None = None
        self._estimator = estimator_for(self.card) if settings.estimates else None

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
            return ScriptedController(solves=row == "solution")
        rollouts = self.rollouts() if row == "model" else self._simulator_rollouts(row == "codec")
        return PlanningController(planner, rollouts, make_cost(self.settings), usual=self._usual)

    def rollouts(self) -> ModelRollouts:
        """The rollouts of the model."""
        return ModelRollouts(self._world, self.card, self._estimator, **self.settings.rollouts())

    def estimate(self, episodes: Sequence[tuple[str, int]]) -> str:
        """How long it takes at most to play these, rows and seeds, from a decision of each planner.

        Episodes that are solved end earlier, and those without a planner take little. It is empty
        if no planner decides anything.
        """
        counts = Counter(row for row, _ in episodes if row in PLANNED_ROWS)
        spec, seconds = spec_of_seed(self.card, episodes[0][1]), 0.0
        for row, count in counts.items():
            controller = self.controller(row)
            assert isinstance(controller, PlanningController)
            with passed_over():
                frame, _ = self.environment.reset(options={"spec": spec})
                parts = self.environment.environment, self.environment.task
                controller.begin(*parts, self.environment.goal)
                taken = len(controller.act(History(spec, [frame])))
                decisions = -(-self.environment.task.max_steps // taken)
                seconds += count * decisions * controller.decisions[0].seconds
        return f"at most about {duration(seconds)} for {len(episodes)} episodes" if seconds else ""

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
        for each in (self.environment, self._branches):
            if each is not None:
                each.close()

    def _simulator_rollouts(self, coded: bool) -> SimulatorRollouts:
        if self._branches is None:
            self._branches = self._make_environment()
        codec = self._world.codec
        estimator = self._estimator if coded else None
        return SimulatorRollouts(self._branches, codec.temporal_stride, codec, estimator)

    def _make_environment(self) -> Environment:
        return make_environment(self.card.name, {"size": self.card.frame_size})


def make_planner(settings: Settings) -> Planner:
    """Create the planner of these settings."""
    return _create("planner", settings.planner, Planner)


def make_cost(settings: Settings) -> Cost:
    """Create the cost of these settings."""
    return _create("cost", settings.cost, Cost)


def _create(kind: Any, choice: Mapping[str, Any], base: type[Any]) -> Any:
    params = {name: value for name, value in choice.items() if name != "name"}
    return catalog().component(kind, choice["name"]).create_as(base, **params)


def declared_settings(run: str | Path, task: str) -> tuple[str, ...]:
    """The settings that a task of a run's environment declares; see `Task.planning`."""
    name = DatasetCard.read(RunFolder(find_run(run)).card).environment.name
    return catalog().component("environment", name).load_task(task).planning


def usual_actions(run: Path) -> list[float] | None:
    """Standard deviation `[A]` of the raw actions that a model was trained on; None if unknown."""
    statistics = DatasetCard.read(RunFolder(run).card).actions.get("train")
    return None if statistics is None else [*statistics["std"]]


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
    tell: Callable[[str], None] = lambda text: None,
) -> list[RowSummary]:
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
        report: called with the result of every episode.
        tell: called with an estimate of how long it takes, before it starts.

    Returns:
        The table of all episodes in `out`.
    """
    weights = RunFolder(run).weights
    player = EpisodePlayer(load_run(run), task, settings, device, usual_actions(run))
    goal_task, digest = player.environment.task, read_metadata(weights).get("sha256")
    identity = {"environment": player.card.name, "task": task, "weights": digest}
    # reports recognise the weights by the file's hash
    facts = {
        "unit": goal_task.unit,
        "tolerance": goal_task.tolerance,
        "file_sha256": file_sha256(weights),
    }
    results = ResumableResults(out, {**identity, **settings.to_dict()}, kind=EpisodeLine)
    left = LeftOut()
    try:
        with results.adding():
            missing = [*missing_episodes(rows, seeds, results.finished())]
            if len(missing) > 1 and (about := player.estimate(missing)):
                tell(about)
            for row, seed in missing:
                if row in left.rows or seed in left.solved:
                    continue
                with left.trying(row, seed):
                    result, controller = player.play(row, seed)
                    if seed in seeds[:videos]:
                        player.write_video(out / VIDEOS, row, seed, result, controller)
                    line = {"row": row, "seed": seed, **result.facts()}
                    results.add(line)
                    _write_table(results, {**facts, **left.facts()})
                    report(line)
            if left.error and not results.finished():
                raise left.error
            return _write_table(results, {**facts, **left.facts()})
    finally:
        player.close()


def _write_table(results: ResumableResults, facts: Mapping[str, Any]) -> list[RowSummary]:
    """Write the table and the page of the results so far; `facts` are added to the table's file."""
    table = summarise(results.finished())
    about = results.settings
    write_page(results.folder, f"{about['task']} in {about['environment']}", about, table)
    rows = [asdict(each) for each in table]
    write_summary(results.folder, {**about, **facts, "rows": rows})
    return table
