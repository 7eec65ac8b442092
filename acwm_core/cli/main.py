"""All commands of `acwm`. Their modules import nothing heavy until a command runs."""

from __future__ import annotations

import click

from acwm_core import __version__
from acwm_core.cli.check import check
from acwm_core.cli.compare import compare, leaderboard
from acwm_core.cli.data import data
from acwm_core.cli.demo import demo
from acwm_core.cli.doctor import doctor
from acwm_core.cli.encode import encode
from acwm_core.cli.evaluate import evaluate, report, rollout
from acwm_core.cli.experiment import experiment
from acwm_core.cli.generate import generate
from acwm_core.cli.group import AcwmGroup
from acwm_core.cli.import_checkpoint import import_checkpoint
from acwm_core.cli.new import new
from acwm_core.cli.parts import list_components, show
from acwm_core.cli.train import fit


@click.group(cls=AcwmGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="acwm")
def main() -> None:
    """Action-conditioned video world models: simulate, train, evaluate.

    Begin with `acwm demo`: it simulates a small dataset, trains a world model on it and writes a
    report, all on this machine.
    """


for _command in (
    demo,
    list_components,
    show,
    generate,
    data,
    encode,
    fit,
    import_checkpoint,
    evaluate,
    report,
    compare,
    leaderboard,
    rollout,
    experiment,
    check,
    new,
    doctor,
):
    main.add_command(_command)
