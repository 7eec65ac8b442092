"""`acwm plan`: act in the true simulator by planning with a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, seeds_of

if TYPE_CHECKING:
    from acwm_planning.resumable import Line
    from acwm_planning.settings import Settings
    from acwm_planning.table import RowSummary


@click.command()
@click.argument("run", type=RUN)
@click.argument("task")
@click.argument("overrides", nargs=-1)
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
    "--preset", default="default", help="Settings that OVERRIDES change: stable_worldmodel."
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
    """Act in TASK by planning with the model of RUN.

    Model-predictive control: plans are executed in the simulator, and planning restarts from what
    really happened. OVERRIDES change the settings: planner=cem planner.candidates=300 cost=state
    cost.frames=1 past=2 (see `acwm list planner`, `acwm list cost`). Writes a line per episode, a
    summary, and videos. If it is interrupted, run the same command again to continue.
    """
    from acwm_planning.settings import ROW_NAMES, settings_of, words_of

    # reports misspelt settings and rows before the slow import of torch
    settings_of(overrides, preset).rows(rows)

    from acwm_core.executors import progress_bar
    from acwm_planning.run import declared_settings, plan_episodes

    declared = declared_settings(run, task)
    settings = settings_of(overrides, preset, declared)
    effective = list(words_of(settings.to_dict()))
    click.echo(f"settings: {' '.join(effective)}")
    if other := [word for word in declared if word not in effective]:
        click.echo(f"not as the task declares: {' '.join(other)}")
    where = out or run / "planning" / task
    if landscape:
        draw_landscapes(run, task, settings, seeds, where, device)
        return
    if compare and settings.differentiates and not rows:
        click.echo("no row of the simulator: planner=gradient needs gradients, and it has none")
        rows = tuple(row for row in ROW_NAMES if row not in ("simulator", "codec"))
    chosen = settings.rows(rows or (ROW_NAMES if compare else ("model",)))

    with progress_bar(f"planning {task}", len(seeds) * len(chosen)) as advance:

        def report(line: Line) -> None:
            advance(1)
            end = "solved" if line["success"] else "failed" if line["failed"] else "not solved"
            click.echo(f"{line['row']} {line['seed']}: {end} after {line['steps']} actions")

        table = plan_episodes(
            run,
            task,
            settings,
            seeds=seeds,
            rows=chosen,
            out=where,
            videos=videos,
            device=device,
            report=report,
            tell=lambda text: click.echo(text, err=True),
        )
    print_table(table)
    click.echo(where)


def draw_landscapes(
    run: Path, task: str, settings: Settings, seeds: Sequence[int], out: Path, device: str
) -> None:
    """Draw the cost landscape of each episode, and print where the true action is in it."""
    from acwm_core.executors import progress_bar
    from acwm_core.training.run import load_run
    from acwm_planning.landscape import SIDE, draw, landscape
    from acwm_planning.left_out import LeftOut
    from acwm_planning.run import EpisodePlayer, usual_actions

    player = EpisodePlayer(load_run(run), task, settings, device, usual_actions(run))
    left, told = LeftOut(), list[str]()
    click.echo(f"per episode, {SIDE * SIDE + 1} plans in the simulator and in the model", err=True)
    try:
        with progress_bar(f"landscapes of {task}", len(seeds)) as advance:
            for seed in seeds:
                with left.trying("the landscape", seed):
                    found = landscape(player, seed)
                    path = draw(found, player.card.action, out / f"landscape-{seed:04d}.png")
                    ranks = found.ranks.items()
                    shares = ", ".join(f"{rank:.1%} in the {each}" for each, rank in ranks)
                    told.append(f"{path}: cheaper than the true action are {shares}")
                advance(1)
        if left.error and not told:
            raise left.error
    finally:
        player.close()
    click.echo("\n".join(told))


def print_table(table: Sequence[RowSummary]) -> None:
    """Print a line per row, in at most 80 columns, and what the columns are."""
    from rich.console import Console
    from rich.table import Table

    from acwm_planning.table import HEADS

    grid = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for head in HEADS:
        narrow = head.replace(" / ", " /\n")
        grid.add_column(narrow, justify="right" if head else "left", overflow="fold")
    for row in table:
        grid.add_row(*row.cells())
    Console(highlight=False, markup=False).print(grid)
    click.echo(
        "95 %: exact interval of the success; p: of McNemar's test against the first row;\n"
        "final distance: mean in the end, of that at the start"
    )
