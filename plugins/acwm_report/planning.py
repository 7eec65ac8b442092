"""`acwm plan` and `acwm rank`: act with a model in the simulator, and show what it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, seeds_of
from acwm_report.terminal import print_page_table, print_ranking

if TYPE_CHECKING:
    from acwm_planning.resumable import Line
    from acwm_planning.settings import Settings


@click.command()
@click.argument("run", type=RUN)
@click.argument("task", required=False)
@click.argument("overrides", nargs=-1)
@click.option(
    "--goal",
    type=click.Path(path_type=Path),
    help="Instead of TASK: plan towards what this picture shows, without a simulator.",
)
@click.option(
    "--start", type=click.Path(path_type=Path), help="With --goal: a picture to start from."
)
@click.option(
    "--episode",
    type=int,
    help="Instead of TASK or --start: start as this recorded test episode does; without --goal, "
    "to the frame that it reaches in the time of a plan.",
)
@click.option("--seeds", default="0", callback=seeds_of, help="Episodes: 0,1,2 or 0..49.")
@click.option("--out", type=OUT_FOLDER, help="Folder of the results; RUN/planning/TASK by default.")
@click.option(
    "--compare",
    is_flag=True,
    help="On the same episodes, also the planner on the true simulator (and through the codec), "
    "the scripted solution, the behaviour policy, random actions, and doing nothing.",
)
@click.option("--row", "rows", multiple=True, metavar="ROW", help="Only this row of --compare.")
@click.option(
    "--preset",
    default="default",
    help="Preset settings, which OVERRIDES change: stable_worldmodel.",
)
@click.option("--videos", default=3, help="Number of episodes to write videos of.")
@click.option(
    "--landscape",
    is_flag=True,
    help="Only draw, for each episode, the cost over a grid of two actions around those of the "
    "scripted solution, in the simulator and in the model.",
)
@click.option("--device", default="auto", help="Device of the model: cpu, cuda, cuda:1, …")
def plan(
    run: Path,
    task: str | None,
    overrides: tuple[str, ...],
    goal: Path | None,
    start: Path | None,
    episode: int | None,
    seeds: tuple[int, ...],
    out: Path | None,
    compare: bool,
    rows: tuple[str, ...],
    preset: str,
    videos: int,
    landscape: bool,
    device: str,
) -> None:
    """Act in TASK by planning with the model of RUN.

    Model-predictive control: plans are executed in the simulator, and planning restarts from what
    really happened. OVERRIDES change the settings: planner=cem planner.candidates=300 cost=state
    cost.frames=1 past=2 (see `acwm list planner`, `acwm list cost`). Writes a line per episode, a
    summary, and videos. If it is interrupted, run the same command again to continue.

    With --goal or --episode, it makes one plan towards a picture, writes its actions and a video of
    the prediction, and executes nothing. This works for recordings too.
    """
    if task is None or "=" in task or goal or episode is not None:
        words = [word for word in (task, *overrides) if word is not None]
        plan_to_picture(run, words, preset, goal, start, episode, out, device)
        return
    if start:
        raise click.UsageError("--start belongs to --goal: leave out TASK, or --start")
    plan_task(run, task, overrides, seeds, out, compare, rows, preset, videos, landscape, device)


def plan_task(
    run: Path,
    task: str,
    overrides: tuple[str, ...],
    seeds: tuple[int, ...],
    out: Path | None,
    compare: bool,
    rows: tuple[str, ...],
    preset: str,
    videos: int,
    landscape: bool,
    device: str,
) -> None:
    """Play the episodes of a task, or draw their cost landscapes; see `plan`."""
    from acwm_planning.settings import ROW_NAMES, settings_of

    # reports misspelt settings and rows before the slow import of torch
    settings_of(overrides, preset).rows(rows)

    from acwm_planning.run import declared_settings, plan_episodes

    declared = declared_settings(run, task)
    settings = settings_of(overrides, preset, declared)
    show_settings(run, settings, declared)
    where = out or run / "planning" / task
    if landscape:
        draw_landscapes(run, task, settings, seeds, where, device)
        return
    if compare and settings.differentiates and not rows:
        click.echo(
            "no row of the simulator: planner=gradient needs gradients, which it does not have"
        )
        rows = tuple(row for row in ROW_NAMES if row not in ("simulator", "codec"))
    chosen = settings.rows(rows or (ROW_NAMES if compare else ("model",)))

    from acwm_report.plan_page import write_plan_page

    def report(line: Line) -> None:
        end = "solved" if line["success"] else "failed" if line["failed"] else "not solved"
        click.echo(f"{line['row']} {line['seed']}: {end} after {line['steps']} actions")
        write_plan_page(where)

    plan_episodes(
        run,
        task,
        settings,
        seeds=seeds,
        rows=chosen,
        out=where,
        videos=videos,
        device=device,
        report=report,
        progress=True,
    )
    print_page_table(write_plan_page(where))
    click.echo(where)


def show_settings(run: Path, settings: Settings, declared: Sequence[str]) -> None:
    """Print the settings, what their cost depends on, and those that differ from the task's."""
    from acwm_planning.run import facts_of_cost
    from acwm_planning.settings import words_of

    effective = list(words_of(settings.to_dict()))
    click.echo(f"settings: {' '.join(effective)}")
    for name, text in facts_of_cost(run, settings).items():
        click.echo(f"{name}: {text}")
    if other := [word for word in declared if word not in effective]:
        click.echo(f"different from the task's: {' '.join(other)}")


def plan_to_picture(
    run: Path,
    words: Sequence[str],
    preset: str,
    goal: Path | None,
    start: Path | None,
    episode: int | None,
    out: Path | None,
    device: str,
) -> None:
    """Make one plan to a picture, and say what it is worth."""
    from acwm_planning.settings import settings_of

    if named := [word for word in words if "=" not in word]:
        raise click.UsageError(f"give the task {named[0]}, or --goal and --episode")
    if goal is None and episode is None:
        raise click.UsageError("give a TASK, or --goal PICTURE (or --episode N) for recordings")
    if (start is None) == (episode is None):
        raise click.UsageError("a plan starts from --start PICTURE or from --episode N: give one")
    settings_of(words, preset)  # reports misspelt settings before the slow import of torch

    from acwm_core.training.run import load_run
    from acwm_formats.images import picture_of_size
    from acwm_planning.pictures import PicturePlanner, begin_of, write_plan
    from acwm_planning.run import action_std_of

    bundle = load_run(run)
    own = ["cost=points"] if bundle.world_model.keypoint_names else []
    settings = settings_of(words, preset, own)
    show_settings(run, settings, ())
    planner = PicturePlanner(bundle, settings, device, action_std_of(run))
    size = bundle.card.frame_size
    if start is not None:
        now = picture_of_size(start, size)
        frames, actions, reached = [now], [], now
    else:
        ahead = settings.planner.get("horizon", 5) * settings.planner.get("action_block", 4)
        data = bundle.recipe.data["path"]
        frames, actions, reached = begin_of(bundle, data, episode or 0, goal is None, ahead)
    made = planner.plan(frames, actions, picture_of_size(goal, size) if goal else reached)
    where = out or run / "planning" / "picture"
    write_plan(where, made, bundle.card)
    click.echo(
        f"{len(made.actions)} actions whose imagined cost is {made.cost:.3g}; without motion it is "
        f"{made.still_cost:.3g}"
    )
    click.echo(where)


def draw_landscapes(
    run: Path, task: str, settings: Settings, seeds: Sequence[int], out: Path, device: str
) -> None:
    """Draw the cost landscape of each episode, and print where the true action is in it."""
    from acwm_core.executors import progress_bar
    from acwm_core.training.run import load_run
    from acwm_core.training.threads import use_threads
    from acwm_planning.landscape import SIDE, draw, landscape
    from acwm_planning.left_out import LeftOut
    from acwm_planning.run import EpisodePlayer, action_std_of

    player = EpisodePlayer(load_run(run), task, settings, device, action_std_of(run))
    left, messages = LeftOut(), list[str]()
    use_threads(None, None, choose=True)
    click.echo(f"per episode, {SIDE * SIDE + 1} plans in the simulator and in the model", err=True)
    try:
        with progress_bar(f"landscapes of {task}", len(seeds)) as advance:
            for seed in seeds:
                with left.trying("the landscape", seed):
                    costs = landscape(player, seed)
                    path = draw(costs, player.card.action, out / f"landscape-{seed:04d}.png")
                    ranks = costs.ranks.items()
                    shares = ", ".join(f"{rank:.1%} in the {judge}" for judge, rank in ranks)
                    messages.append(f"{path}: cheaper than the true action: {shares}")
                advance(1)
        if left.error and not messages:
            raise left.error
    finally:
        player.close()
    click.echo("\n".join(messages))


@click.command()
@click.argument("run", type=RUN)
@click.argument("task")
@click.option(
    "--policies",
    multiple=True,
    default=("scripted",),
    metavar="POLICY",
    help="Policy to rank; repeat for several. scripted (the default) stands for all built-in ones; "
    "or name one of them, such as solution,skill=0.7,noise=0.3,bias=0.15; or, for your own, "
    "module:name or the folder of a trained one.",
)
@click.option("--seeds", default="0..7", callback=seeds_of, help="Episodes: 0,1,2 or 0..49.")
@click.option("--out", type=OUT_FOLDER, help="Folder of the results; RUN/ranking/TASK by default.")
@click.option("--steps", type=click.IntRange(1), help="Sampling steps; the model's own by default.")
@click.option("--device", default="auto", help="Where the model runs.")
def rank(
    run: Path,
    task: str,
    policies: tuple[str, ...],
    seeds: tuple[int, ...],
    out: Path | None,
    steps: int | None,
    device: str,
) -> None:
    """Rank policies at TASK by rolling them out in the model of RUN.

    The same policies act in the true simulator from the same starts, which shows how far the
    model's ranking can be trusted: correlations, rank violations, optimism, and the loss from
    choosing actions as the model would. Your own policies see the model's predictions (closed
    loop); scripted ones need the simulator, so the model receives the actions that they take there
    (open loop). If it is interrupted, run the same command again to continue.
    """
    from acwm_planning.policies.scripted import parse_policy

    for word in policies:  # reports misspelt names before the slow import of torch
        if word != "scripted" and ":" not in word and not Path(word).is_dir():
            parse_policy(word)

    from acwm_planning.policies.run import rank_policies

    where = out or run / "ranking" / task
    ranking = rank_policies(
        run, task, policies, seeds=seeds, out=where, steps=steps, device=device, progress=True
    )
    print_ranking(ranking)
    click.echo(where)
