"""The curve on a model's card, of a stranger's file: read, or refused in one sentence."""

import pytest

from acwm_core.errors import DataError
from acwm_zoo.model_card import _curve, _hours

HEAD = b"step,val/loss\n"


@pytest.mark.parametrize("rows", [b"1,0.5\n2,0.25\n", b"1,0.5,7\n2,0.25\n", b"0\n1,0.5\n2,0.25\n"])
def test_losses_are_shown(rows, tmp_path):
    (tmp_path / "metrics.csv").write_bytes(HEAD + rows)
    assert "| 2 | 0.5 |\n| 3 | 0.25 |\n" in _curve(tmp_path / "metrics.csv")


@pytest.mark.parametrize("content", [b"", HEAD, b"step,train/loss\n1,0.5\n"])
def test_there_may_be_none(content, tmp_path):
    assert _curve(tmp_path / "metrics.csv") == ""
    (tmp_path / "metrics.csv").write_bytes(content)
    assert _curve(tmp_path / "metrics.csv") == ""


@pytest.mark.parametrize(
    "content",
    [
        b"a,b\n1,2\n",
        HEAD + b"x,1\n",
        HEAD + b"1,nan\n",
        HEAD + b"1,<script>\n",
        HEAD + b"1,\x00\n",
        HEAD + b"1," + b"9" * 200_000,
        b"\xff\xfe",
    ],
)
def test_what_is_damaged_is_named(content, tmp_path):
    (tmp_path / "metrics.csv").write_bytes(content)
    with pytest.raises(DataError, match=r"metrics.csv is damaged \(.*\): restore or remove it"):
        _curve(tmp_path / "metrics.csv")


def test_hours_may_be_unknown():
    assert _hours({}) == ""
    assert _hours({"cpu_seconds": 7200}) == ", 2.0 CPU-hours"
