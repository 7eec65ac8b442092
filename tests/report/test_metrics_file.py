"""Curves of a `metrics.csv`: the numbers of csv's own reader, and few of millions."""

import csv
import tracemalloc

import pytest

from acwm_report.metrics_file import POINTS, logged


def test_rows_that_have_the_number_are_read(tmp_path):
    rows = ["step,train/loss,val/loss", "0,1.5,", "1,,0.25", "2,1e-3,", "3,wrong,", "4,nan,", "5,2"]
    (tmp_path / "metrics.csv").write_text("\n".join(rows))
    steps, losses = logged(tmp_path, "train/loss")
    assert (steps, losses[:2]) == ([0, 2, 4], [1.5, 1e-3])
    assert losses[2] != losses[2]
    assert logged(tmp_path, "val/loss") == ([1], [0.25])
    assert logged(tmp_path, "nothing") == ([], [])
    (tmp_path / "metrics.csv").write_text("")
    assert logged(tmp_path, "train/loss") == logged(tmp_path / "none", "train/loss") == ([], [])


def test_many_rows_are_averaged_in_bounded_memory(tmp_path):
    count = 400_000
    with (tmp_path / "metrics.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["step", "train/loss", "train/learning_rate"])
        writer.writerows((step, step % 7, 1e-4) for step in range(count))
    tracemalloc.start()
    steps, losses = logged(tmp_path, "train/loss")
    assert tracemalloc.get_traced_memory()[1] < 60 * count  # a row in dicts takes ten times that
    tracemalloc.stop()
    assert POINTS / 2 < len(steps) <= POINTS
    assert steps[0] == pytest.approx(49.5)
    assert losses[0] == pytest.approx(sum(n % 7 for n in range(100)) / 100)
    assert steps[-1] == pytest.approx(count - 1 - 49.5)
