"""The commands of this plugin have their place, and acwm works without it."""

import click
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.plugins import Catalog, catalog, hookimpl
from acwm_experiment.files import read_experiment
from acwm_experiment.plan import make_plan
from acwm_experiment.steps import all_steps


def listed():
    return main.list_commands(click.Context(main))


@pytest.fixture
def without_the_plugin(fresh_catalog, monkeypatch):
    found = Catalog._entry_points
    kept = lambda self: [each for each in found(self) if each.name != "acwm_report"]  # noqa: E731
    monkeypatch.setattr(Catalog, "_entry_points", kept)


def test_a_plugin_places_its_commands(fresh_catalog):
    class Plugin:
        @hookimpl
        def register_commands(self, registry):
            places = {"second": "first", "first": "fit", "itself": "itself", "lost": "nowhere"}
            circle = {"one": "other", "other": "one"}
            for name, after in {**places, **circle, "odd": ["fit"]}.items():
                registry.add(name, "acwm_report.commands:report", after=after)
            registry.add("anywhere", "acwm_report.commands:report")

    before = listed()
    catalog().add_plugin(Plugin(), "places")
    after = listed()
    assert after.index("second") == after.index("first") + 1 == after.index("fit") + 2
    assert [name for name in after if name in before] == before
    new = {*after} - {*before}
    assert new == {"first", "second", "itself", "lost", "one", "other", "odd", "anywhere"}
    for name in new - {"first", "second"}:
        assert after.index(name) >= len(main.commands)
    assert len(after) == len(before) + len(new)


def test_without_it_its_commands_are_not_there(without_the_plugin):
    assert not {"evaluate", "report", "compare", "leaderboard"} & {*listed()}
    assert [name for name in listed() if name in main.commands] == [*main.commands]
    for command in ("evaluate", "report", "compare", "leaderboard"):
        ended = CliRunner().invoke(main, [command, "somewhere"], prog_name="acwm")
        assert (ended.exit_code, ended.stdout) == (2, "")
        assert ended.stderr.startswith(f"acwm: there is no command '{command}'; ")
        assert ended.stderr.endswith("(see acwm --help)\n")
    assert CliRunner().invoke(main, ["--help"]).exit_code == 0


def test_without_it_nothing_is_to_be_reported(without_the_plugin, tmp_path):
    plan = make_plan(read_experiment("ablations/conditioning_small"), tmp_path)
    assert {step.kind for step in all_steps(plan)} == {"simulate", "train", "evaluate"}


def test_without_it_the_demo_says_so_before_it_works(without_the_plugin, monkeypatch, tmp_path):
    pytest.importorskip("acwm_zoo")
    monkeypatch.setattr(
        "acwm_zoo.demo.Progress.work", lambda *_, **__: pytest.fail("it went to work")
    )
    ended = CliRunner().invoke(main, ["demo", "--out", str(tmp_path / "demo")])
    assert ended.exit_code == 2
    assert ended.stderr.startswith("acwm: unknown command 'report'")
