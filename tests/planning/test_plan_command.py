"""`acwm plan`, from words to videos and a table."""

import hashlib
import html
import json
import re
import shutil

import av
import pytest

from acwm_core.cli import main
from acwm_core.env.task import Goal
from acwm_core.evaluation.results import write_json
from acwm_planning.results import PlanTable
from acwm_planning.settings import ROW_NAMES, settings_of
from acwm_report.plan_page import write_plan_page
from tests import tiny

FEW = ["planner.candidates=6", "planner.iterations=2", "planner.elites=3", "planner.horizon=2"]


@pytest.fixture
def mine(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


def acwm(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    captured = capsys.readouterr()
    return ended.value.code, captured.out, captured.err


def lines(folder):
    return [json.loads(text) for text in (folder / "episodes.jsonl").read_text().splitlines()]


def test_a_table_is_made_and_gone_on_with(mine, capsys):
    words = ["plan", mine, "place", *FEW, "cost=state", "--compare", "--videos", "1"]
    code, out, err = acwm(capsys, *words, "--seeds", "0,1")
    assert code == 0, err
    folder = mine / "planning" / "place"
    made = lines(folder)
    assert {(each["row"], each["seed"]) for each in made} == {
        (r, s) for r in ROW_NAMES for s in (0, 1)
    }
    summary = json.loads((folder / "summary.json").read_text())
    assert [row["row"] for row in summary["rows"]] == list(ROW_NAMES)
    assert summary["planner"]["candidates"] == 6
    page = (folder / "index.html").read_text()
    assert all(f'src="videos/{row}-0000.mp4"' in page for row in ROW_NAMES)
    assert re.search(r">No motion<.*?<td[^>]*>0/2<", page, re.DOTALL)
    videos = sorted(path.name for path in (folder / "videos").iterdir())
    assert videos == sorted(f"{row}-0000.{kind}" for row in ROW_NAMES for kind in ("mp4", "json"))
    assert summary["unit"] == "px"
    weights = hashlib.sha256((mine / "model.safetensors").read_bytes()).hexdigest()
    assert summary["file_sha256"] == weights
    (steps,) = [each["steps"] for each in made if (each["row"], each["seed"]) == ("model", 0)]
    with av.open(folder / "videos/model-0000.mp4") as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == steps + 1
    assert frames[0].shape[1] > 2.9 * frames[0].shape[0]  # happened, imagined and goal
    assert str(folder) in out
    assert re.search(r"at most about \d+ s for 14 episodes", err)
    check_video(folder, made, steps)

    code, _, err = acwm(capsys, *words, "--seeds", "0..2")
    assert code == 0, err
    assert lines(folder)[: len(made)] == made  # nothing is played twice
    assert len(lines(folder)) == len(made) + len(ROW_NAMES)

    code, _, err = acwm(capsys, *words, "past=1")
    assert (code, "holds results of another past" in err) == (2, True)


def check_video(folder, made, steps):
    """The curves beside the model's video are those of its episode."""
    video = json.loads((folder / "videos/model-0000.json").read_text())
    (line,) = [each for each in made if (each["row"], each["seed"]) == ("model", 0)]
    assert (video["unit"], video["tolerance"], video["seed"]) == ("px", 1.5, 0)
    assert video["panels"] == ["happened", "imagined", "goal"]
    assert len(video["distances"]) == len(video["imagined"]) == steps + 1
    assert video["distances"][0] == pytest.approx(line["start_distance"], rel=1e-3)
    assert video["distances"][-1] == pytest.approx(line["distance"], rel=1e-3)
    assert video["imagined"][0] == pytest.approx(video["distances"][0], abs=4)  # blocks of pixels
    assert len(video["plans"]) == line["decisions"]
    stride = video["plans"][0]["frames"][0]
    assert video["plans"][0]["frames"] == [stride * n for n in range(1, 1 + 8 // stride)]
    # what was taken is the beginning of what was planned
    assert video["plans"][0]["distances"][0] == video["imagined"][stride]
    still = json.loads((folder / "videos/still-0000.json").read_text())
    assert (still["imagined"], still["plans"], still["panels"]) == ([], [], ["happened", "goal"])


def test_settings_that_a_task_declares_come_before_those_of_the_user():
    declared = ("cost=state", "planner.candidates=40", "past=1")
    settings = settings_of(["planner.candidates=50"], declared=declared)
    assert (settings.cost["name"], settings.planner["candidates"], settings.past) == (
        "state",
        50,
        1,
    )
    named = settings_of(["planner=cem", "cost=latent"], declared=declared)
    assert (named.planner["name"], named.cost["name"]) == ("cem", "latent")
    assert named.planner["candidates"] == 128  # another planner has its own defaults
    preset = settings_of([], "stable_worldmodel", declared)
    assert preset == settings_of(
        ["past=1"], "stable_worldmodel"
    )  # of which the preset says nothing


def test_the_page_shows_settings_that_make_the_same_plans_again(tmp_path):
    settings = settings_of(["planner.spread=null", "planner.warm_start=false", "past=1"])
    about = {"environment": "slide", "task": "place"}
    write_json(tmp_path / "summary.json", PlanTable(**about, rows=[]))
    write_json(tmp_path / "settings.json", {**about, **settings.to_dict()})
    write_plan_page(tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    shown = re.search(r"<code>(.*?)</code>", page)[1]
    assert "planner.spread=null" in shown
    assert settings_of(html.unescape(shown).split()) == settings


def test_the_command_takes_what_a_task_declares(mine, capsys, monkeypatch):
    monkeypatch.setattr(tiny.PLACE, "planning", ("cost=state", "planner.horizon=2"), raising=False)
    words = ["plan", mine, "place", "--row", "still", "--videos", "0"]
    code, told, _ = acwm(capsys, *words, "cost=latent")
    assert code == 0
    found = json.loads((mine / "planning/place/settings.json").read_text())
    assert (found["cost"]["name"], found["planner"]["horizon"]) == ("latent", 2)
    assert "planner.horizon=2" in told.splitlines()[0]
    assert told.splitlines()[1] == "different from the task's: cost=state"


def solved_at_the_start(*indices):
    """A task of the tiny world of which these episodes are solved at their start."""
    draw = tiny.PLACE.sample_goal

    def sample_goal(environment, rng):
        solved = environment.episode_spec.index in indices
        return Goal.now(environment) if solved else draw(environment, rng)

    return sample_goal


def test_episodes_that_are_solved_at_their_start_are_left_out(mine, capsys, monkeypatch):
    monkeypatch.setattr(tiny.PLACE, "sample_goal", solved_at_the_start(1), raising=False)
    words = ["plan", mine, "place", "--row", "still", "--row", "random", "--videos", "0"]
    code, _, err = acwm(capsys, *words, "--seeds", "0..2")
    assert code == 0
    assert "solved at the start of episode 1 of ind_test" in err
    folder = mine / "planning" / "place"
    assert [(each["row"], each["seed"]) for each in lines(folder)] == [
        (row, seed) for seed in (0, 2) for row in ("random", "still")
    ]
    assert json.loads((folder / "summary.json").read_text())["solved_at_start"] == [1]
    code, _, err = acwm(capsys, *words, "--seeds", "1", "--out", mine / "none")
    assert (code, "solved at the start" in err) == (2, True)


def test_an_episode_that_fails_does_not_end_the_others(mine, capsys, monkeypatch):
    draw = tiny.PLACE.sample_goal

    def sample_goal(environment, rng):
        if environment.episode_spec.index == 1:
            raise ZeroDivisionError("no place")
        return draw(environment, rng)

    monkeypatch.setattr(tiny.PLACE, "sample_goal", sample_goal, raising=False)
    words = ["plan", mine, "place", "--row", "still", "--videos", "0"]
    code, _, err = acwm(capsys, *words, "--seeds", "0..2")
    assert code == 0, err
    assert "still with seed 1 is left out: ZeroDivisionError: no place" in err
    folder = mine / "planning" / "place"
    assert [each["seed"] for each in lines(folder)] == [0, 2]
    ((row, seed, _),) = json.loads((folder / "summary.json").read_text())["failed"]
    assert (row, seed) == ("still", 1)
    code, _, err = acwm(capsys, *words, "--seeds", "1", "--out", mine / "none")
    assert (code, "no place" in err, "Traceback" in err) == (2, True, False)


def test_a_planner_that_needs_gradients_is_compared_without_the_simulator(capsys, tmp_path):
    recurrent = {"name": "recurrent", "channels": 8, "width": 8, "blocks": 1}
    parts = {"model": recurrent, "conditioner": {"name": "adaln", "embedding": "stacked"}}
    parts["objective"] = {"name": "regression"}
    mine = tiny.make_slide_run(tmp_path, parts=parts)
    words = ["plan", mine, "place", "planner=gradient", "planner.iterations=2", "--videos", "0"]
    code, out, err = acwm(capsys, *words, "--compare")
    assert code == 0, err
    rows = {each["row"] for each in lines(mine / "planning/place")}
    assert rows == set(ROW_NAMES) - {"simulator", "codec"}
    assert "no row of the simulator" in out
    code, _, err = acwm(capsys, *words, "--row", "simulator")
    assert (code, "needs a cost that is differentiable" in err) == (2, True)


def test_one_episode_needs_no_more_than_a_run_and_a_task(mine, capsys, tmp_path):
    out = tmp_path / "elsewhere"
    rows = ["--row", "model", "--row", "codec"]  # which is the simulator where no state is read
    code, _, err = acwm(capsys, "plan", mine, "place", *FEW, *rows, "--out", out)
    assert code == 0, err
    (only,) = lines(out)
    assert (only["row"], only["seed"]) == ("model", 0)


def test_a_task_without_a_solution_has_no_such_row(mine, capsys):
    words = ["--row", "solution", "--row", "still", "--videos", "0"]
    code, _, err = acwm(capsys, "plan", mine, "shy", *words)
    assert code == 0, err
    assert [each["row"] for each in lines(mine / "planning" / "shy")] == ["still"]
    summary = json.loads((mine / "planning" / "shy" / "summary.json").read_text())
    assert summary["left_out"] == ["solution"]
    assert summary["rows"][0]["seeds"] == [0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "unknown slide task 'nowhere'"),
        (["place", "planner=cen"], "did you mean 'cem'?"),
        (["place", "planner.candidate=3"], "did you mean 'candidates'?"),
        (["place", "planner.candidates=many"], "planner.candidates=many: expected int"),
        (["place", "cost=nothing"], "unknown cost 'nothing'"),
        (["place", "cost=callable"], "needs the parameter 'function'"),
        (["place", "horizon=3"], "horizon is not a setting of planning"),
        (["place", "past=-1"], "past=-1: give 0 or more"),
        (["place", "past=some"], "past=some: expected int"),
        (["place", "planner.elites=1"], "planner.elites=1: give 2 or more"),
        (["place", "planner"], "is not an override"),
        (["place", "--seeds", "3..1"], "give numbers of episodes"),
        (["place", "--seeds", "1,1"], "give numbers of episodes"),
        (["place", "--row", "nobody"], "unknown row 'nobody'"),
        (["place", "--preset", "mine"], "unknown preset 'mine'"),
        (["place", "planner.horizon=9"], "trained on clips of 9 frames"),
        (
            ["place", "planner=gradient", "cost=state", "planner.horizon=2"],
            "needs a cost that is differentiable",
        ),
    ],
)
def test_bad_words_are_one_sentence(run, capsys, words, message):
    code, _, err = acwm(capsys, "plan", run, *words)
    assert code == 2
    assert message in err
    assert "Traceback" not in err


def test_a_plan_that_failed_at_once_leaves_its_folder_to_other_settings(mine, capsys):
    folder = ["--out", mine / "planning" / "again", "--videos", "0"]
    code, _, err = acwm(capsys, "plan", mine, "place", "planner.horizon=9", *folder)
    assert (code, "plan at most 8 actions" in err) == (2, True), err
    quick = ["planner.horizon=2", "planner.candidates=4", "planner.elites=2"]
    code, _, err = acwm(capsys, "plan", mine, "place", *quick, *folder)
    assert code == 0, err
    page = (mine / "planning" / "again" / "index.html").read_text(encoding="utf-8")
    assert " planner.horizon=2 " in page
    assert "{" not in re.search(r"<h1>.*</main>", page, re.DOTALL)[0]


def test_a_run_that_is_not_there(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = acwm(capsys, "plan", "nothing", "place")
    assert (code, "no run folder nothing" in err) == (2, True)


def test_the_preset_is_that_of_stable_worldmodel():
    preset = settings_of([], "stable_worldmodel")
    planner = preset.planner
    assert planner["name"] == "cem"
    assert (planner["candidates"], planner["iterations"], planner["elites"]) == (300, 30, 30)
    assert (planner["horizon"], planner["action_block"]) == (5, 5)
    assert planner["actions_per_plan"] == 25
    assert (preset.goal_ahead, preset.max_steps) == (25, 50)
    assert preset.cost == {"name": "latent", "frames": 1}
    changed = settings_of(["planner.candidates=9", "planner=icem"], "stable_worldmodel")
    assert (changed.planner["name"], changed.planner["candidates"]) == ("icem", 9)
    assert changed.planner["iterations"] == 6  # another planner has its own defaults
