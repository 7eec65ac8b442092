"""`acwm rank`: rank policies in a model, and measure how well the true simulator agrees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, seeds_of

if TYPE_CHECKING:
    from acwm_core.evaluation.statistics import Estimate
    from acwm_planning.policies.ranking import Ranking


@click.command()
@click.argument("run", type=RUN)
@click.argument("task")
@click.option(
    "--policies",
    multiple=True,
    default=("scripted",),
    metavar="POLICY",
    help="Policy to rank; repeat for several. scripted (the default) is all built-in ones; or give "
    "one of them, such as solution,skill=0.7,noise=0.3,bias=0.15, or module:name for your own.",
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

    The same policies act in the true simulator from the same starts, which tells how far the
    model's ranking can be trusted: correlations, rank violations, optimism, and what is lost by
    choosing actions as the model would. Policies of your own see what the model predicts (closed
    loop); scripted ones look at the simulator, so the model is given the actions they take there
    (open loop). Stopped at any point, the same command resumes.
    """
    from acwm_planning.policies.scripted import parse_policy

    for word in policies:  # reports misspelt names before the slow import of torch
        if word != "scripted" and ":" not in word:
            parse_policy(word)

    from acwm_planning.policies.run import rank_policies

    where = out or run / "ranking" / task
    ranking = rank_policies(
        run, task, policies, seeds=seeds, out=where, steps=steps, device=device, progress=True
    )
    print_ranking(ranking)
    click.echo(where)


def print_ranking(ranking: Ranking) -> None:
    """Print the policies, best true score first, and how well the judges agree with the truth."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:  # a file or a pipe has no width
        console.width = 200
    scores = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    heads = ("policy", "loop", "success\n(true)", "(model)", "return\n(true)", "(model)")
    for head in heads:
        scores.add_column(head, justify="left" if head in ("policy", "loop") else "right")
    for each in ranking.policies:
        success = (f"{100 * each.success[judge]:.0f} %" for judge in ("truth", "model"))
        returns = (f"{each.returns[judge]:.3g}" for judge in ("truth", "model"))
        scores.add_row(each.policy, each.loop, *success, *returns)
    console.print(scores)
    console.print(f"\n{len(ranking.policies)} policies, {ranking.episodes} episodes of each")
    for each in ranking.policies:
        for judge, count in each.unread.items():
            console.print(
                f"{each.policy}: in {count} of {ranking.episodes} episodes the estimator could not "
                f"read the distance in the {'true' if judge == 'estimator' else 'predicted'} "
                "frames; the start distance is used instead"
            )
    agreement = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for head in ("", "of", "Pearson", "Spearman", "Kendall", "MMRV", "optimism"):
        agreement.add_column(head, justify="left" if head in ("", "of") else "right")
    for judge, by_score in ranking.agreement.items():
        for score, each in by_score.items():
            values = each.pearson, each.spearman, each.kendall, each.mmrv, each.optimism
            cells = (format_estimate(value).replace(" (", "\n").rstrip(")") for value in values)
            agreement.add_row(judge, score.replace("returns", "return"), *cells)
    console.print(agreement)
    console.print(
        "below each number its 95 % interval; MMRV: mean maximum rank violation;\n"
        "optimism: judge minus truth; estimator: reads the true frames, a ceiling"
    )
    for judge, decisions in ranking.decisions.items():
        console.print(
            f"{judge}: choosing among action sequences loses {format_estimate(decisions.regret)} "
            f"{ranking.unit}\nper action, at random {format_estimate(decisions.chance)}"
        )


def format_estimate(estimate: Estimate) -> str:
    """Format an estimate, e.g. ``0.82 (0.61…0.93)``."""
    if estimate.value is None:
        return "–"
    known = estimate.low is not None and estimate.high is not None
    interval = f" ({estimate.low:.2g}…{estimate.high:.2g})" if known else ""
    return f"{estimate.value:.2g}{interval}"
