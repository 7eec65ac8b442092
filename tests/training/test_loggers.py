import csv

from acwm_core import executors
from acwm_core.training.fit import fit
from acwm_core.training.loggers import MetricsFile
from tests.tiny import tiny_recipe


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_new_numbers_get_their_columns_and_old_rows_stay(tmp_path):
    path = tmp_path / "metrics.csv"
    log = MetricsFile(path)
    log.log_metrics({"train/loss": 0.1 + 0.2, "epoch": 0}, step=0)  # to the last bit
    log.log_metrics({"train/loss": 1.25, "epoch": 0}, step=1)
    log.log_metrics({"val/loss": 0.1}, step=1)
    log.log_metrics({"epoch": 0}, step=2)
    assert rows(path) == [
        {"step": "0", "train/loss": "0.30000000000000004", "val/loss": ""},
        {"step": "1", "train/loss": "1.25", "val/loss": ""},
        {"step": "1", "train/loss": "", "val/loss": "0.1"},
    ]


def test_a_resumed_run_drops_what_it_repeats(tmp_path):
    path = tmp_path / "metrics.csv"
    first = MetricsFile(path)
    for step in range(5):
        first.log_metrics({"train/loss": float(step)}, step=step)
    again = MetricsFile(path, first_step=3)
    again.log_metrics({"train/loss": 30.0}, step=3)
    wanted = {"0": "0.0", "1": "1.0", "2": "2.0", "3": "30.0"}
    assert {row["step"]: row["train/loss"] for row in rows(path)} == wanted


def test_a_fresh_run_replaces_a_stray_file(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,train/loss\n7,1.0\n")
    MetricsFile(path).log_metrics({"train/loss": 2.0}, step=0)
    assert rows(path) == [{"step": "0", "train/loss": "2.0"}]


def test_encoding_before_the_first_step_is_told_in_lines_without_a_terminal(
    data, tmp_path, monkeypatch, capsys
):
    """With latents that no other test has made, by their gain."""
    monkeypatch.setattr(executors, "LINE_EVERY_S", 0)
    fit(tiny_recipe(data, codec={"gain": 1.7}, trainer={"max_steps": 1}), tmp_path / "run")
    said = capsys.readouterr().err.splitlines()
    lines = [line.split()[:4] for line in said if line.startswith("encoding train  ")]
    assert lines == [["encoding", "train", f"{n}/8", "episodes"] for n in range(1, 9)]
