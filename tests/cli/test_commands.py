"""The command line: help, listings, and errors in one sentence with exit code 2."""

import os
import re
import signal
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from acwm_core.cli import main
from acwm_core.cli.main import AcwmGroup
from acwm_core.interrupts import exit_by_signal
from acwm_core.plugins import Problem, Registry, catalog, hookimpl
from acwm_core.recipe import compose


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], prog_name="acwm")


def refused(*arguments: str | Path) -> str:
    """The one sentence with which a command is refused."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("acwm: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_the_promised_commands_are_there_in_the_order_of_their_use() -> None:
    promised = (
        "list show generate data encode fit import-checkpoint evaluate report compare leaderboard "
        "benchmark score plan rank policy rollout play serve experiment check new doctor "
    )
    listed = main.list_commands(click.Context(main))
    assert " ".join(listed).startswith(promised)
    assert {"demo", "push", "ship"} <= {*listed[len(promised.split()) :]}


def test_list_shows_every_component() -> None:
    output = run("list").output
    counts = output.partition("\n\n")[0]
    for kind in catalog().kinds:
        components = [*catalog().registry(kind)]
        assert re.search(rf"^\s*{len(components)}\s+{kind}\s*$", counts, re.M), kind
        assert all(component.name in output for component in components)
    only = run("list", "codec").output
    assert "compact" in only
    assert "dit_xs" not in only


class Needy:
    @hookimpl
    def register_environments(self, registry: Registry) -> None:
        registry.add("needy", "x:Y", extra="sim", requires=("no_such_engine",))


def test_list_says_what_is_missing_and_broken(fresh_catalog: None) -> None:
    catalog().add_plugin(Needy(), "needy", "needy")
    catalog().problems.append(Problem("broken", "RuntimeError: boom"))
    output = " ".join(run("list").output.split())
    assert "(needs no_such_engine: pip install 'needy[sim]')" in output
    assert "plugin 'broken' was left out: RuntimeError: boom" in output


def test_show_prints_a_recipe_that_stands_on_its_own(tmp_path: Path) -> None:
    result = run("show", "push_cube_small", "conditioner=cross_attention", "objective.steps=7")
    assert result.exit_code == 0
    shown = yaml.safe_load(result.output)
    assert shown["conditioner"]["name"] == "cross_attention"
    saved = tmp_path / "saved.yaml"
    saved.write_text(result.output)
    assert compose(saved).to_dict() == shown


def test_mistakes_are_one_sentence() -> None:
    assert "there is no command 'lst'; did you mean 'list'?" in refused("lst")
    assert "to continue a run, type `acwm fit resume=RUN`" in refused("resume", "runs/mine")
    assert "--size" in refused("generate", "push_cube", "--siz", "64")
    assert "(see acwm show --help)" in refused("show")
    assert "'--episodes': 0" in refused("data", "preview", "--episodes", "0", "nowhere")
    assert "did you mean 'push_cube_small'?" in refused("show", "push_cube_smal")
    assert "did you mean 'layers'?" in refused("fit", "push_cube_small", "model.layer=3")
    assert "did you mean 'push_cube'?" in refused("generate", "push_cub")
    assert "did you mean 'compact'?" in refused("check", "compac")
    assert "there are no checks of executors" in refused("check", "slurm", "executor.sbatch=x")
    assert "write codec.PARAMETER=VALUE" in refused("check", "compact", "model.layers=3")
    assert "did you mean 'friction'?" in refused(
        "generate", "push_cube", "factors.frction=ood", "--episodes", "2"
    )
    assert "sets no factor" in refused("generate", "push_cube", "size=64")
    assert "sets no factor" in refused("generate", "push_cube", "factors.friction=[1]")
    assert "'--size': 6a: give a side" in refused("generate", "push_cube", "--size", "6a")


def test_a_pipe_is_no_recipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "mine.yaml")
    for words in (("fit",), ("show",)):
        assert "mine.yaml is not a file" in refused(*words, tmp_path / "mine.yaml")


def test_what_is_not_there_is_one_sentence_that_suggests_another(tmp_path: Path) -> None:
    assert "there is no run folder" in refused("evaluate", tmp_path / "nowhere")
    assert "acwm generate" in refused("data", "info", tmp_path / "nowhere")
    (tmp_path / "push_cube").mkdir()
    for marker in ("recipe.yaml", "card.yaml"):
        assert f"it has no {marker}" in refused(*OF_FOLDER[marker], tmp_path / "push_cube")
        (tmp_path / "push_cube" / marker).touch()
        near = f"did you mean '{tmp_path / 'push_cube'}'?"
        assert near in refused(*OF_FOLDER[marker], tmp_path / "push_cub")
    out = ("--out", tmp_path / "run")
    for override in ("resume", "data.path"):
        assert near in refused(
            "fit", "push_cube_small", f"{override}={tmp_path / 'push_cub'}", *out
        )


OF_FOLDER = {"recipe.yaml": ("evaluate",), "card.yaml": ("data", "info")}


def test_interrupts_and_bugs_are_told_apart() -> None:
    @click.group(cls=AcwmGroup)
    def group() -> None:
        """Commands that end badly."""

    @group.command()
    def stopped() -> None:
        signal.raise_signal(signal.SIGINT)

    core: dict[str, Any] = {"__name__": "acwm_core.anything"}  # what plugins raise ends otherwise
    exec("def fail(): 1 / 0", core)

    @group.command()
    def buggy() -> None:
        core["fail"]()

    result = CliRunner().invoke(group, ["stopped"])
    assert (result.exit_code, result.stderr.strip()) == (130, "acwm: stopped")
    assert isinstance(CliRunner().invoke(group, ["buggy"]).exception, ZeroDivisionError)


def test_check_passes_on_our_own_and_fails_on_a_bad_one(monkeypatch: pytest.MonkeyPatch) -> None:
    good = run("check", "mse")
    assert (good.exit_code, "FAIL" in good.output) == (0, False)
    from acwm_metrics import pixel

    monkeypatch.setattr(pixel.MSE, "per_frame", lambda self, rollout: np.zeros(3))
    bad = run("check", "mse")
    assert (bad.exit_code, "FAIL" in bad.output) == (1, True)


def test_check_of_a_metric_takes_its_parameters_and_an_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = dict[str, Any]()

    def suite(name: str, **parameters: Any) -> list[Any]:
        given.update(parameters)
        return []

    monkeypatch.setattr("acwm_core.checks.check_metric", suite)
    assert run("check", "lpips", "metric.network=vgg", "env=push_cube").exit_code == 0
    assert given == {"network": "vgg", "environment": "push_cube"}
    assert "did you mean 'network'?" in refused("check", "lpips", "metric.netwrok=vgg")
    assert "metric.network=res: expected" in refused("check", "lpips", "metric.network=res")
    assert "did you mean 'push_cube'?" in refused("check", "mask_iou", "env=push_cub")
    wrong = refused("check", "mask_iou", "model.layers=3")
    assert "write metric.PARAMETER=VALUE or env=NAME" in wrong


def test_a_command_of_a_plugin_ends_as_click_commands_do() -> None:
    """An exit code, a usage error, and a signal are no errors of the plugin."""
    codes: dict[str, tuple[int, str]] = {}

    @click.command()
    @click.argument("how")
    @click.pass_context
    def ends(context: click.Context, how: str) -> int:
        if how == "exit":
            context.exit(3)
        if how == "usage":
            raise click.BadParameter("not that")
        if how == "signal":
            exit_by_signal(15, None)
        return 4

    group = AcwmGroup("group", commands={"ends": ends})
    for how in ("exit", "usage", "signal", "return"):
        result = CliRunner().invoke(group, ["ends", how])
        codes[how] = (result.exit_code, result.stderr.strip())
    assert codes["exit"] == (3, "")
    assert codes["usage"][0] == 2
    assert "not that" in codes["usage"][1]
    assert codes["signal"] == (143, "")
    assert codes["return"] == (4, "")
