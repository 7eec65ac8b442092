"""`acwm policy`: train a policy in a model, evaluate it, and improve both in turn."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER, ExistingFolder, seeds_of
from acwm_planning.rewards import HEAD_FILE
from acwm_report.terminal import print_page_table

POLICY = ExistingFolder(
    "policy's folder", "policy.safetensors", "`acwm policy train ENVIRONMENT.TASK`"
)

RECIPE_SECTIONS = ("training.", "trainer.", "data.", "objective.")
"""With what an override of a model's recipe begins."""


def model_of(task: str, words: Sequence[str]) -> str:
    """The model among the words of a command; by default that of the environment."""
    models = [word for word in words if "=" not in word]
    if len(models) > 1:
        raise click.BadParameter(f"give one model, not {', '.join(models)}")
    return models[0] if models else task.partition(".")[0]


@click.group()
def policy() -> None:
    """Train a policy in a model, and evaluate it in the simulator."""


@policy.command()
@click.argument("task", metavar="ENVIRONMENT.TASK")
@click.argument("words", nargs=-1, metavar="[MODEL] [OVERRIDES]...")
@click.option(
    "--in",
    "place",
    type=click.Choice(["dream", "simulator", "recordings"]),
    help="What the policy learns from: acting in the model or in the simulator, or recordings; by "
    "default the first that the algorithm can use.",
)
@click.option(
    "--steps",
    type=click.IntRange(1),
    help="Steps of all scenes together, or moments of recordings; by default as many as the "
    "algorithm declares. An action is held for a step, which is a latent frame.",
)
@click.option(
    "--scenes",
    type=click.IntRange(1),
    help="Scenes side by side; by default 64 in the dream, 1 in the simulator.",
)
@click.option(
    "--starts",
    type=click.IntRange(1),
    default=256,
    help="Training episodes whose first frames and goals are used.",
)
@click.option(
    "--data",
    type=DATASET,
    help="Dataset to take them from (by default the simulator draws them), or to imitate.",
)
@click.option(
    "--reward",
    type=ExistingFolder("reward's folder", HEAD_FILE, "`acwm train-reward DATA --from COLUMN`"),
    help="Where there is no task, reward of states to maximise (`acwm train-reward`).",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of the training.")
@click.option(
    "--out", type=OUT_FOLDER, help="The policy's folder; runs/policies/ENVIRONMENT.TASK by default."
)
@click.option("--device", default="auto", help="Device of the model.")
def train(task: str, words: tuple[str, ...], place: Any, out: Path | None, **options: Any) -> None:
    """Train a policy for a task by acting in a model of its environment.

    MODEL is a run folder or a trained model; the trained model of the environment by default. It
    must predict states. OVERRIDES choose the algorithm (`acwm list learner`) and set its
    parameters: algorithm=sac learning_rate=1e-3 policy_kwargs.net_arch=[64,64]. observe=[…] chooses
    fields of the state, and bonus=1 is the reward for success. algorithm=clone imitates the
    recordings of --data. To imitate, or to maximise a --reward, give ENVIRONMENT without a task. If
    it is interrupted, run the same command again to continue; with more --steps it trains on.
    """
    from acwm_policy.settings import settings_of

    model = model_of(task, words)
    settings = settings_of([word for word in words if "=" in word])

    from acwm_planning.policies.saved import default_folder
    from acwm_policy.train import train_policy

    where = out or default_folder(task)
    trained = train_policy(
        model, task, settings=settings, out=where, place=place, progress=True, **options
    )
    facts = trained.card.training
    click.echo(f"{where}: {facts['steps']} steps in {facts['cpu_seconds']:.0f} s of processor time")
    if "error" in facts:
        click.echo(
            f"lowest error on held-out recordings: {facts['error']:.2f} "
            "(1: no better than the mean action)"
        )
    if "reward" in facts:
        click.echo(f"error of the reward: {facts['reward']['held_out']}")
    if trained.card.task or "reward" in facts:
        click.echo(f"next: acwm policy evaluate {shlex.quote(str(where))}")


@policy.command()
@click.argument("task", metavar="ENVIRONMENT.TASK")
@click.argument("words", nargs=-1, metavar="[MODEL] [OVERRIDES]...")
@click.option("--rounds", type=click.IntRange(0), default=3, help="Rounds after the first policy.")
@click.option(
    "--episodes",
    type=click.IntRange(1),
    default=32,
    help="Episodes that the policy collects in the simulator in a round.",
)
@click.option(
    "--noise",
    type=click.FloatRange(0, 1),
    default=0.2,
    help="Noise of its decisions there, a share of half the range of an action.",
)
@click.option(
    "--data",
    type=DATASET,
    help="Simulated dataset to add them to, such as the model's own; by default it begins with as "
    "many episodes of the behaviour policy.",
)
@click.option(
    "--steps",
    type=click.IntRange(1),
    help="Steps that the policy learns for in a round; by default as many as the algorithm "
    "declares.",
)
@click.option("--scenes", type=click.IntRange(1), help="Scenes side by side; 64 by default.")
@click.option(
    "--starts", type=click.IntRange(1), default=256, help="Training episodes to start from."
)
@click.option("--seeds", default="0..19", callback=seeds_of, help="Episodes that measure a round.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of the training.")
@click.option("--workers", type=click.IntRange(0), help="Processes that simulate; one per core.")
@click.option(
    "--out", type=OUT_FOLDER, help="The folder; runs/improved/ENVIRONMENT.TASK by default."
)
@click.option(
    "--in",
    "place",
    type=click.Choice(["dream", "simulator"]),
    default="dream",
    help="Where the policy learns: in the model, or without it in the simulator, to compare with.",
)
@click.option(
    "--beside",
    type=ExistingFolder(
        "folder of rounds", "rounds.csv", "`acwm policy improve ENVIRONMENT.TASK --in simulator`"
    ),
    help="Other rounds of the task to show on the page, such as those --in simulator.",
)
@click.option("--device", default="auto", help="Device of the model while the policy learns.")
def improve(
    task: str, words: tuple[str, ...], out: Path | None, beside: Path | None, **options: Any
) -> None:
    """Improve a model and a policy in turn: collect, train both further, and measure.

    In each round the policy acts in the simulator, with noise; what it did is added to the data;
    the model is trained further on all of it, and the policy in the model. MODEL and OVERRIDES are
    those of `acwm policy train`; overrides of the model's recipe have its sections in front, such
    as trainer.max_steps=400. Each round measures the success in the dream and in the simulator on
    the same episodes. If it is interrupted, run the same command again to continue; with more
    --rounds it goes on.
    """
    from acwm_policy.settings import settings_of

    of_recipe = [word for word in words if word.startswith(RECIPE_SECTIONS)]
    own = [word for word in words if "=" in word and word not in of_recipe]
    settings, where = settings_of(own), out or Path("runs/improved") / task

    from acwm_policy.improve import improve_policy
    from acwm_report.policy_page import PAGE_FILE, rounds_beside, write_rounds_page

    other = None if beside is None else rounds_beside(beside, task, len(options["seeds"]))
    lines = improve_policy(
        model_of(task, words),
        task,
        settings=settings,
        out=where,
        recipe=of_recipe,
        report=lambda lines: write_rounds_page(where, lines, other),
        progress=True,
        **options,
    )
    print_page_table(write_rounds_page(where, lines, other))
    click.echo(where / PAGE_FILE)


@policy.command()
@click.argument("folder", type=POLICY, metavar="POLICY")
@click.option("--seeds", default="0..19", callback=seeds_of, help="Episodes: 0,1,2 or 0..49.")
@click.option(
    "--run", metavar="MODEL", help="Model to dream in; by default the one it was trained with."
)
@click.option(
    "--beside",
    type=POLICY,
    metavar="POLICY",
    help="Another policy for the task to compare with, e.g. one trained in the simulator.",
)
@click.option("--videos", default=3, help="Number of episodes to write videos of.")
@click.option("--out", type=OUT_FOLDER, help="Folder of the results; POLICY/evaluation by default.")
@click.option("--device", default="auto", help="Device of the model.")
def evaluate(folder: Path, **options: Any) -> None:
    """Measure how often a trained policy succeeds in the simulator.

    All rows begin at the same starts, of the test split: the policy, another one --beside it,
    random actions, no motion, the behaviour policy that collects data, and the script that knows
    the goal if the task has one; and the policy in the model. The gap is by how much more often it
    succeeds in the model than in the simulator, because of the model's errors. In the simulator the
    policy observes true states. Writes a page with the table, learning curves, and videos. If it is
    interrupted, run the same command again to continue.
    """
    from acwm_policy.evaluate import EVALUATION, evaluate_policy
    from acwm_report.policy_page import PAGE_FILE, gap_text, write_policy_page

    results = evaluate_policy(folder, progress=True, **options)
    where = options["out"] or folder / EVALUATION
    if "held_out" in results:
        click.echo(f"error of the reward: {results['held_out']}")
    print_page_table(write_policy_page(folder, where, results, options["beside"]))
    if results["gap"] is None:
        click.echo(
            "no row in the dream: the model does not predict all that the policy observes, or "
            "moves at another rate (observe=[…] chooses fields)"
        )
    else:
        click.echo(f"gap (dream − simulator): {gap_text(results['gap'])}")
        if results["dream_alone"]:
            seeds = ", ".join(map(str, results["dream_alone"]))
            click.echo(f"solved in the dream alone: episodes {seeds}; collect more like them")
    click.echo(where / PAGE_FILE)
