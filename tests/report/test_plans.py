"""What plans and rankings of a run are worth: on its page, in leaderboards and comparisons."""

import json
import re
import shutil
from dataclasses import asdict

import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.data.video import write_mp4
from acwm_core.errors import AcwmWarning
from acwm_core.evaluation.results import Summary, write_json
from acwm_planning.policies.ranking import RANKING_FILE
from acwm_planning.results import EpisodeCurves
from acwm_planning.results import PlannedDistances as Expected
from acwm_planning.table import summarise
from acwm_report.comparison import compare_runs
from acwm_report.leaderboard import write_leaderboard
from acwm_report.page import export_report, write_report
from acwm_report.plan_page import write_plan_page
from acwm_report.plan_videos import PlanVideo, VideoRoom, plan_videos
from acwm_report.plans import plan_tables
from acwm_report.run import EvaluatedRun
from tests.report import synthetic
from tests.report.test_rankings import ranking


def line(row, seed, *, success):
    facts = {"failed": False, "steps": 9, "start_distance": 0.4, "distance": 0.1 + 0.1 * seed}
    return {"row": row, "seed": seed, "success": success, "decisions": 3, **facts}


def add_plans(run, task="<place>", weights=None, wins=6):
    """A table as `acwm plan` makes it of eight episodes, and a video of the second one."""
    lines = [line("model", n, success=n < wins) for n in range(8)]
    lines += [line("still", n, success=False) for n in range(8)]
    weights = weights or Summary.read(run).provenance["weights_sha256"]
    about = {"environment": "drift", "task": task, "unit": "m", "file_sha256": weights}
    folder = run / "planning" / "place"
    (folder / "videos").mkdir(parents=True)
    rows = [asdict(each) for each in summarise(lines)]
    (folder / "summary.json").write_text(json.dumps({**about, "planner": {}, "rows": rows}))
    curves = EpisodeCurves(
        row="model",
        seed=1,
        success=False,
        failed=False,
        unit="m",
        tolerance=0.05,
        fps=10,
        panels=["happened", "imagined", "goal"],
        distances=[0.4, 0.3, 0.3, 0.35],
        imagined=[0.4, 0.3, None, 0.1],
        plans=[Expected([1, 2, 9], [0.3, 0.2, 0.0]), Expected([3], [0.1])],
    )
    (folder / "videos" / "model-0001.json").write_text(json.dumps(asdict(curves)))
    rng = np.random.default_rng(0)
    write_mp4(folder / "videos/model-0001.mp4", rng.integers(0, 255, (4, 16, 48, 3), np.uint8), 10)
    return run


def make_run(folder, shift=0.0, **facts):
    return synthetic.run(folder, synthetic.clips(np.linspace(20, 26, 8) + shift), **facts)


@pytest.fixture
def planned(tmp_path):
    return add_plans(make_run(tmp_path / "planned"))


def test_a_table_of_plans_stands_on_the_page_and_in_files(planned, tmp_path):
    text = write_report([planned]).read_text()
    assert "<h2>Planning with this model</h2>" in text
    assert "&lt;place&gt; · 8 episodes" in text
    assert "<place>" not in text
    # Clopper and Pearson's of 6 of 8, from tables of the beta distribution
    assert re.search(r"75<small>35 to 97</small>", text)
    names = {path.name: path for path in export_report([planned], tmp_path / "out")}
    (csv,) = [n for n in names if n.startswith("plans-") and n.endswith(".csv")]
    head, first, second = names[csv].read_text().splitlines()
    assert head.startswith("Controller,note,Solved,Share,Share_low,Share_high,Final distance,")
    assert "0.75," in first
    assert second.startswith("No motion,,0.0,0.0,0.0,")


def test_a_film_shows_where_the_plan_went_wrong(planned):
    text = write_report([planned]).read_text()
    assert text.count("data:video/mp4;base64,") == 1
    assert "Episode 1, not solved after 3 actions" in text
    assert "model error up to 25.0 cm, after 3 actions" in text
    run = EvaluatedRun.read(planned, "run1")
    assert [len(each) for each in plan_videos([run], VideoRoom(1))] == [1]
    assert plan_videos([run], VideoRoom(0.0001)) == [[]]


def test_curves_are_those_of_the_file(planned):
    values = json.loads((planned / "planning/place/videos/model-0001.json").read_text())
    curves = EpisodeCurves(**values | {"plans": [Expected(**each) for each in values["plans"]]})
    drawn = PlanVideo("key", "place", curves, "").drawing
    assert drawn.top == "40.0 cm"
    assert drawn.tolerance == pytest.approx(1 - 0.05 / 0.4)
    assert drawn.happened == ["0.0000,0.0000 0.3333,0.2500 0.6667,0.2500 1.0000,0.1250"]
    assert drawn.imagined == ["0.0000,0.0000 0.3333,0.2500", "1.0000,0.7500"]  # a gap in between
    assert drawn.plans == [
        "0.3333,0.2500 0.6667,0.5000",
        "1.0000,0.7500",
    ]  # no further than the end
    assert drawn.widest == 1.0
    assert curves.widest_gap == (3, pytest.approx(0.25))


def test_the_page_of_a_plan_links_to_the_videos_that_can_be_read(planned):
    folder = planned / "planning" / "place"
    write_json(folder / "settings.json", {"past": 1})
    (folder / "videos" / "still-0001.json").write_text("{")
    with pytest.warns(AcwmWarning, match="still-0001.json is not curves of a video"):
        write_plan_page(folder)
    page = (folder / "index.html").read_text()
    assert page.count("<video") == page.count('src="videos/model-0001.mp4"') == 1
    assert "past=1" in page
    assert "&lt;place&gt; in drift" in page


def test_plans_of_other_weights_are_not_shown(tmp_path):
    run = add_plans(make_run(tmp_path / "other"), weights="0" * 64)
    assert plan_tables(EvaluatedRun.read(run, "run1")) == []
    assert compare_runs([run, make_run(tmp_path / "second", 1)]).uses == []


def test_damaged_plans_are_named(planned, tmp_path):
    other = make_run(tmp_path / "other")
    (planned / "planning/place/videos/model-0001.json").write_text("{")
    with pytest.warns(AcwmWarning, match=r"model-0001\.json is not curves of a video"):
        text = write_report([other, planned]).read_text()
    assert "1 result could not be read" in text


@pytest.fixture
def both(tmp_path):
    """A run that was ranked and planned with, and one that was not."""
    first = add_plans(make_run(tmp_path / "board" / "first", weights="1" * 64))
    (first / "ranking" / "place").mkdir(parents=True)
    write_json(first / "ranking" / "place" / RANKING_FILE, ranking("1" * 64))
    return first, make_run(tmp_path / "board" / "second", 1, weights="2" * 64)


def test_a_leaderboard_has_rankings_and_plans_and_drops_no_run(both):
    page, found = write_leaderboard(both[0].parent)
    assert found.broken == {}  # the table of plans is no evaluation
    assert sorted(found.entries) == ["first", "second"]
    uses = page.read_text().partition("Usefulness of the models")[2]
    rows = re.findall(r'<tr>\s*<th scope="row">(?:<.*?>)*(\w+)(.*?)</tr>', uses, re.DOTALL)
    second, first = rows  # the best in distribution first, as above
    assert [first[0], second[0]] == ["first", "second"]
    assert "75<small>35 to 97</small>" in first[1]
    assert "0.75<small>0.50 to 0.90</small>" in first[1]
    assert "−0.25<small>−0.50 to 0.00</small>" in first[1].replace("+0.00", "0.00")
    cells = re.findall(r"<td[^>]*>(.*?)</td>", second[1])
    assert cells == ["–"] * len(cells)
    assert len(cells) == 8


def test_no_table_where_no_run_has_either(tmp_path):
    make_run(tmp_path / "board" / "plain")
    page, _ = write_leaderboard(tmp_path / "board")
    assert "Usefulness" not in page.read_text()


def test_a_damaged_ranking_takes_no_run_off_the_leaderboard(both):
    (both[0] / "ranking" / "place" / RANKING_FILE).write_text("[]")
    _, found = write_leaderboard(both[0].parent)
    assert sorted(found.entries) == ["first", "second"]
    assert [*found.broken] == ["first: rankings and plans"]


def test_links_out_of_a_run_are_not_followed(both, tmp_path):
    elsewhere = shutil.move(both[0] / "planning", tmp_path / "elsewhere")
    (both[0] / "planning").symlink_to(elsewhere)
    _, found = write_leaderboard(both[0].parent)
    assert "leads out of" in found.broken["first: rankings and plans"]


def test_a_comparison_tells_both_with_intervals(both, capsys, tmp_path):
    out = tmp_path / "comparison.json"
    with pytest.raises(SystemExit) as ended:
        main(["compare", *map(str, both), "--out", str(out)])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    lines = {" ".join(each.split()) for each in printed.splitlines()}
    assert "<place>: ranking policies, spearman ↑ 0.75 (0.50 to 0.90) –" in lines
    assert "<place>: planning, solved ↑ % 75 (35 to 97) –" in lines
    uses = json.loads(out.read_text())["uses"]
    (solved,) = [use for use in uses if use["measure"] == "success"]
    assert (solved["run"], solved["episodes"]) == ("first", 8)
    assert solved["estimate"]["value"] == 0.75
