"""The demo, rehearsed at its smallest, and again: what is finished is not done twice."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.recipe import compose
from acwm_core.training.signals import StoppedEarly
from acwm_zoo import demo


@pytest.mark.slow
def test_demo_runs_and_goes_on(tmp_path: Path) -> None:
    arguments = ["demo", "--quick", "--out", str(tmp_path)]
    first = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert first.exit_code == 0, first.output
    report = tmp_path / "report.html"
    assert report.stat().st_size > 10_000
    assert first.stdout.rstrip().endswith(str(report))
    assert first.stderr.index(f"open {report} now") < first.stderr.index("training for")
    for word in ("ind_test", "ood_test", "`other actions`", "codec", "psnr dB"):
        assert word in first.stdout
    weights = (tmp_path / "run" / "model.safetensors").read_bytes()

    again = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert again.exit_code == 0
    assert again.stderr.count("already done") == 6  # all but the last page
    assert again.stdout == first.stdout
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == weights


def test_ctrl_c_advises_the_same_command(tmp_path, monkeypatch):
    def fit(*_, **__):
        raise StoppedEarly("stopped by Ctrl-C, saved step 3; continue with resume=runs/demo", 130)

    monkeypatch.setattr("acwm_core.training.fit.fit", fit)
    with pytest.raises(StoppedEarly, match="saved step 3; run the same command again") as raised:
        demo._fit(SimpleNamespace(trainer={"max_steps": 5}), tmp_path / "run")
    assert raised.value.exit_code == 130


def test_the_time_left_is_that_of_all_steps(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(demo.time, "monotonic", lambda: clock[0])

    def taking(seconds: float, done: bool = True) -> Callable[[], bool]:
        def work() -> bool:
            clock[0] += seconds
            return done

        return work

    progress = demo.Progress(3)
    before = demo.Step("done before", 120, taking(0, done=False))
    slow = demo.Step("twice as slow as expected", 60, taking(120))
    progress.work((before, slow), later=240)
    progress.work((demo.Step("the rest", 240, taking(480)),))
    lines = [line for line in capsys.readouterr().err.splitlines() if "left" in line]
    assert [line.split("about ")[1] for line in lines] == [
        f"{minutes} min left" for minutes in (7, 5, 8)
    ]


@pytest.mark.ci
def test_data_that_was_made_before_is_told_so(tmp_path):
    recipe = compose("demo", [f"data.path={tmp_path}"])
    assert demo._generate(recipe, tmp_path, {"ind_test": 1})
    assert not demo._generate(recipe, tmp_path, {"ind_test": 1})
    assert demo._generate(recipe, tmp_path, {"train": 1})
