"""The demo, rehearsed at its smallest, and again: what is finished is not done twice."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.training.signals import StoppedEarly
from acwm_zoo.demo import _fit


@pytest.mark.slow
def test_demo_runs_and_goes_on(tmp_path: Path) -> None:
    arguments = ["demo", "--quick", "--out", str(tmp_path)]
    first = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert first.exit_code == 0, first.output
    report = tmp_path / "report.html"
    assert report.stat().st_size > 10_000
    assert first.stdout.rstrip().endswith(str(report))
    for word in ("ind_test", "ood_test", "`other actions`", "codec", "psnr dB"):
        assert word in first.stdout
    weights = (tmp_path / "run" / "model.safetensors").read_bytes()

    again = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert again.exit_code == 0
    assert again.stderr.count("was done before") == 3  # training and both predictions
    assert again.stdout == first.stdout
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == weights


def test_ctrl_c_advises_the_same_command(tmp_path, monkeypatch):
    def fit(*_, **__):
        raise StoppedEarly("stopped by Ctrl-C, saved step 3; continue with resume=runs/demo", 130)

    monkeypatch.setattr("acwm_core.training.fit.fit", fit)
    with pytest.raises(StoppedEarly, match="saved step 3; run the same command again") as raised:
        _fit(SimpleNamespace(trainer={"max_steps": 5}), tmp_path / "run")
    assert raised.value.exit_code == 130
