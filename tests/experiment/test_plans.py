"""Tasks solved by planning: in files, as steps, killed and gone on with, refused, reported."""

import hashlib
import json
import shutil
import signal

import pytest

from acwm_core.errors import AcwmError
from acwm_core.recipe.check import check_component
from acwm_experiment.files import read_experiment
from acwm_experiment.plan import make_plan
from acwm_experiment.steps import all_steps
from acwm_experiment.table import Experiment
from acwm_planning.jobs import PlanningJob
from acwm_planning.settings import settings_of
from tests.experiment.parts import write_experiment
from tests.folders import wait_until

pytestmark = pytest.mark.ci

FILE = """
title: Planning
overrides: [+small]
rows: {one: {cube: push_cube}}
seeds: [0, 3]
plans:
  Ours:
    seeds: 0..9
    rows: [still, model]
    overrides: [past=1]
    tasks:
      Cube: '"one · cube" place planner.candidates=9'
  Others:
    tasks: {Reacher: reacher reach}
"""


def plan(tmp_path, text=FILE, overrides=(), seeds=None):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    return make_plan(read_experiment(file, overrides, seeds), tmp_path / "out")


def test_a_file_becomes_commands_that_one_would_type(tmp_path):
    made = plan(tmp_path)
    steps = {step.name: step for step in all_steps(made)}
    own = "push_cube+small-0-place-past-1-planner.candidates-9"
    step = steps[f"plan-{own}"]
    assert (step.kind, step.needs) == ("plan", ("train-push_cube+small-0",))
    assert step.title == "plan Ours · Cube · seed 0"
    run, folder = tmp_path / "out/runs/push_cube+small-0", tmp_path / "out/planning" / own
    assert " ".join(step.command) == (
        f"plan {run} place past=1 planner.candidates=9 --seeds 0..9 --row model --row still "
        f"--videos 3 --out {folder}"
    )
    assert steps["plan-reacher-reach"].command[1:5] == ("reacher", "reach", "--seeds", "0..0")
    assert steps["plan-reacher-reach"].command[-1].endswith("/runs/trained/reacher/planning/reach")
    assert {name for name in steps["report"].needs if name.startswith("plan")} == {
        f"plan-{own}", f"plan-{own.replace('-0-', '-3-')}", "plan-reacher-reach",
    }  # fmt: skip
    assert check_component("executor", {"name": "slurm", "folder": "x", "steps": {"plan": "-n1"}})


def test_what_is_written_is_read_again(tmp_path):
    made = plan(tmp_path).experiment
    (tmp_path / "out").mkdir()
    made.write(tmp_path / "out")
    assert Experiment.read(tmp_path / "out") == made
    text = (tmp_path / "out" / "experiment.json").read_text()
    assert '"run": "runs/push_cube+small-0"' in text


def test_words_of_the_command_line_change_plans_if_nothing_is_trained(tmp_path):
    text = "plans: {A: {tasks: {R: reacher reach past=0}, seeds: [0, 2]}}"
    (only,) = plan(tmp_path, text, ["past=3"], [4, 5]).experiment.plans
    assert (only.settings["past"], only.seeds) == (3, (4, 5))
    assert only.folder.is_relative_to(tmp_path / "out")
    mixed = plan(tmp_path, overrides=["trainer.max_steps=7"], seeds=[9]).experiment
    assert (mixed.seeds, mixed.plans[0].seeds) == ((9,), tuple(range(10)))


def test_a_file_that_is_extended_may_lose_tables_and_tasks(tmp_path):
    (tmp_path / "base.yaml").write_text(FILE)
    text = "extends: base.yaml\nplans: {Ours: null, Others: {tasks: {R: push_cube place}}}"
    assert [each.row for each in plan(tmp_path, text).experiment.plans] == ["Reacher", "R"]
    text = "extends: base.yaml\nplans: {Others: {tasks: {Reacher: null}}}"
    assert {each.table for each in plan(tmp_path, text).experiment.plans} == {"Ours"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("tasks: {Reacher", "task: {Reacher", "plans.Others has no `tasks`"),
        ("seeds: 0..9", "seed: 0..9", "unknown entry 'plans.Ours.seed'; did you mean 'seeds'?"),
        ("0..9", "0-9", "plans.Ours.seeds=0-9: give numbers such as 0,1,2 or 0..49"),
        ("0..9", "[1, 1]", "plans.Ours.seeds: give at least one, none twice and none negative"),
        ("[still, model]", "[stil]", "plans.Ours.tasks.Cube: unknown row 'stil'; did you mean"),
        ("[still, model]", "[]", "plans.Ours.tasks.Cube: rows=[]: give one that can be played"),
        ("[past=1]", "[pst=1]", "plans.Ours.tasks.Cube: pst is not a setting of planning"),
        ("candidates=9", "candidates=x", "planner.candidates=x: expected int"),
        ("one · cube", "two · cube", "model or cell of this experiment 'two · cube'; did you mea"),
        ("reacher reach", "reachr reach", "there is no run folder, trained model or cell of thi"),
        ("reacher reach", "reacher reech", "unknown reacher task 'reech'; did you mean 'reach'?"),
        ("reacher reach", "reacher", "plans.Others.tasks.Reacher names no task"),
        ("Reacher: reacher reach", "R: reacher reach, S: reacher reach", "would both be reacher-"),
    ],
)
def test_mistakes_are_one_sentence(old, new, message, tmp_path):
    assert old in FILE
    with pytest.raises(AcwmError) as caught:
        plan(tmp_path, FILE.replace(old, new, 1))
    assert message in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_only_these_weights_settings_rows_and_seeds_count(tmp_path):
    weights, settings = tmp_path / "model.safetensors", settings_of(["past=1"]).to_dict()
    weights.write_bytes(b"weights")
    about = {"environment": "square", "task": "corner", **settings, "left_out": ["solution"]}
    rows = [{"row": "model", "seeds": [0, 1, 2]}, {"row": "still", "seeds": [0]}]
    about |= {"file_sha256": hashlib.sha256(b"weights").hexdigest(), "rows": rows}
    (tmp_path / "summary.json").write_text(json.dumps(about))

    def share(rows, seeds, **settings_of_it):
        task = PlanningJob("", "", tmp_path, "square", "corner",
                           settings | settings_of_it, rows, seeds, tmp_path)  # fmt: skip
        return task.progress()

    assert share(("model", "solution"), (0, 1)) == 1
    assert share(("model", "still"), (0, 1)) == 0.75
    assert share(("model",), (2, 3)) == 0.5
    assert share(("model",), (0, 1), past=2) == 0
    weights.write_bytes(b"others")
    assert share(("model",), (0, 1)) == 0
    (tmp_path / "summary.json").write_text("{")
    assert share(("model",), (0, 1)) == 0


QUICK = "planner.horizon=2 planner.candidates=4 planner.iterations=1 planner.elites=2"

TINY = f"""
title: Corners
rows: {{narrow: tiny}}
data: {{square: {{episodes: [4, 2, 2]}}}}
plans:
  Corners:
    seeds: 0..1
    rows: [model, solution, still]
    videos: 1
    tasks: {{Narrow: narrow corner {QUICK}}}
"""

NAME = f"tiny-0-corner-{QUICK.replace(' ', '-').replace('=', '-')}"

STEPS = 5  # one dataset, training, evaluation and plan, a report


@pytest.fixture(scope="module")
def planned(acwm, tmp_path_factory):
    """An experiment with a plan, and what was printed."""
    folder = tmp_path_factory.mktemp("planned")
    write_experiment(folder, TINY)
    code, out, err = acwm("experiment", "widths.yaml", cwd=folder)
    assert code == 0, out + err
    return folder, out, err


def episodes(folder):
    text = (folder / "episodes.jsonl").read_text()
    return [(line["row"], line["seed"]) for line in map(json.loads, text.splitlines())]


def test_a_model_is_trained_and_plans(planned, acwm):
    folder, out, err = planned
    made = folder / "experiments" / "widths"
    assert out.splitlines()[0] == f"{STEPS} of {STEPS} steps are done"
    assert "plan Corners · Narrow: done" in err
    both = [(row, seed) for seed in (0, 1) for row in ("model", "still")]  # it has no solution
    assert episodes(made / "planning" / NAME) == both
    page = (made / "report.html").read_text()
    assert "<h3>Corners</h3>" in page
    assert "Narrow · corner" in page
    assert "Videos: Corners · Narrow" in page
    assert "Details of this run" in page
    code, out, err = acwm("experiment", "widths.yaml", cwd=folder)
    assert (code, err) == (0, "")
    assert f"{STEPS} of {STEPS} steps are done, {STEPS} of them in earlier runs" in out


def test_a_run_of_one_s_own_plans_without_training(planned, acwm, tmp_path):
    """Killed, it goes on; what it has of more episodes counts, and it has fewer ones already."""
    run = planned[0] / "experiments" / "widths" / "runs" / "tiny-0"
    text = f"plans: {{Own: {{tasks: {{Tiny: {run} corner {QUICK}}}, rows: [model, random]}}}}"
    (tmp_path / "own.yaml").write_text(text)
    command = ("experiment", "own.yaml", "--seeds", "0..19")
    made = tmp_path / "experiments" / "own"
    lines = made / "planning" / NAME / "episodes.jsonl"
    process = acwm.start(*command, cwd=tmp_path)
    wait_until(lambda: lines.exists() and lines.read_text().count("\n") > 2, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = lines.read_text()
    assert 0 < before.count("\n") < 40
    _, out, _ = acwm(*command, "--plan", cwd=tmp_path)
    assert " of 40 episodes" in out.splitlines()[0]
    code, out, err = acwm(*command, cwd=tmp_path)
    assert code == 0, out + err
    assert out.startswith("2 of 2 steps are done\n")
    assert lines.read_text().startswith(before)
    assert sorted(episodes(lines.parent)) == [
        (r, n) for r in ("model", "random") for n in range(20)
    ]
    assert "<h3>Own</h3>" in (made / "report.html").read_text()
    code, out, _ = acwm(*command[:-1], "0..20", "--plan", cwd=tmp_path)
    assert (code, out.splitlines()[0]) == (0, "to do    plan Own · Tiny (40 of 42 episodes)")
    code, out, _ = acwm(*command[:-1], "0..9", "--plan", cwd=tmp_path)
    assert out.splitlines()[-1] == "nothing is left to do"


def test_results_of_other_settings_are_a_failure_with_a_name(planned, acwm, tmp_path):
    shutil.copytree(planned[0], tmp_path, dirs_exist_ok=True)
    made = tmp_path / "experiments" / "widths"
    results = made / "planning" / NAME
    shutil.rmtree(results)
    results.mkdir()
    (results / "settings.json").write_text(json.dumps({"past": 7}))
    code, out, err = acwm("experiment", "widths.yaml", cwd=tmp_path)
    assert code == 1, err
    first, second, *_ = out.splitlines()
    assert first == f"{STEPS - 1} of {STEPS} steps are done, {STEPS - 2} of them in earlier runs"
    assert second.startswith(f"failed: plan-{NAME}: experiments/widths/planning/{NAME} holds resul")
    assert "of another cost, " in second
    assert second.endswith(f"(see experiments/widths/logs/plan-{NAME}.log)")
    page = (made / "report.html").read_text()
    assert ("<h2>Planning</h2>" in page, "Details of this run" in page) == (False, True)
    code, out, _ = acwm("experiment", "widths.yaml", "--plan", cwd=tmp_path)
    assert "failed   plan Corners · Narrow (" in out
