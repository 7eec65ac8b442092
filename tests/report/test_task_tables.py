"""One table of all tasks of an experiment, with their videos, with and without evaluated runs."""

import hashlib
import json

import pytest

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_experiment.table import Experiment, ExperimentCell
from acwm_planning.jobs import PlanningJob
from acwm_report.experiment import evaluated_runs
from acwm_report.page import export_report, write_report
from tests.report.test_plans import add_plans, make_run

WEIGHTS = hashlib.sha256(b"weights").hexdigest()


def task(run, row, table="All worlds", rows=("model", "still"), seeds=tuple(range(8))):
    folder = run / "planning" / "place"
    return PlanningJob(table, row, run, "drift", "place", {"planner": {}}, rows, seeds, folder)


def experiment(*plans, cells=()):
    rows = tuple(cell.row for cell in cells)
    columns = ("",) if cells else ()
    return Experiment(
        "mine", "Mine", "What it is.", None, rows, columns, {}, (0,), tuple(cells), plans
    )


@pytest.fixture
def two(tmp_path):
    """Two runs with plans in metres."""
    runs = [make_run(tmp_path / name, weights=WEIGHTS) for name in ("one", "two")]
    for run in runs:
        (run / "model.safetensors").write_bytes(b"weights")
    return [add_plans(run, task="place") for run in runs]


def test_all_worlds_stand_in_one_table(two, tmp_path):
    made = experiment(task(two[0], "One"), task(two[1], "Two"), task(tmp_path / "no", "Three"))
    made.write(tmp_path)
    read = Experiment.read(tmp_path)
    assert evaluated_runs(tmp_path) == []
    page = write_report([], tmp_path / "page.html", experiment=read).read_text()
    assert page.count("<h3>All worlds</h3>") == 1
    for heading in ("One · place", "Two · place"):
        assert f'colspan="8">{heading}</th>' in page
    assert "What it is. Intervals of shares are exact" in page
    assert "Not run yet: Three." in page
    assert "45.0 cm" in page
    assert "Videos: All worlds · One" in page
    assert page.count("data:video/mp4;base64,") == 2
    files = export_report([], tmp_path / "out", read)
    (csv,) = [path for path in files if path.suffix == ".csv"]
    assert csv.name == "plans-All worlds.csv"
    lines = csv.read_text().splitlines()
    assert lines[0].startswith("group,Controller,note,Solved,Share,Share_low,Share_high,Final dist")
    assert [line.split(",")[0] for line in lines[1:]] == ["One · place"] * 2 + ["Two · place"] * 2


def test_rows_that_nobody_asked_for_and_other_settings_are_not_shown(two, tmp_path):
    fewer = task(two[0], "One", rows=("model",))
    other = PlanningJob(**{**vars(task(two[1], "Two")), "settings": {"planner": {"name": "cem"}}})
    page = write_report([], tmp_path / "page.html", experiment=experiment(fewer, other)).read_text()
    assert "No motion" not in page
    assert "Not run yet: Two." in page


def test_videos_of_a_run_on_the_page_are_shown_once(two, tmp_path):
    cell = ExperimentCell("first", "", "drift", (), (two[0],))
    made = experiment(task(two[0], "One"), task(two[1], "Two"), cells=[cell])
    page = write_report([two[0]], tmp_path / "page.html", experiment=made).read_text()
    assert page.count("data:video/mp4;base64,") == 2
    assert "Videos: All worlds · One" not in page
    assert "Videos: All worlds · Two" in page


def test_an_experiment_without_any_result_is_one_sentence(two, tmp_path, capsys):
    experiment(task(tmp_path / "no", "Three")).write(tmp_path)
    with pytest.raises(DataError, match="is evaluated yet"):
        evaluated_runs(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["report", str(tmp_path)])
    assert ended.value.code == 2
    experiment(task(two[0], "One")).write(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["report", str(tmp_path)])
    assert (ended.value.code, capsys.readouterr().out) == (0, f"{tmp_path}/report.html\n")
    text = (two[0] / "planning/place/summary.json").read_text()
    (two[0] / "planning/place/summary.json").write_text(json.dumps({**json.loads(text), "unit": 3}))
    with pytest.raises(DataError, match="is not a table of plans"):
        write_report([], tmp_path / "page.html", experiment=Experiment.read(tmp_path))
