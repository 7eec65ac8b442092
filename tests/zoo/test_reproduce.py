"""The commands under "Reproduce it" of the models that ship ask for the same again, and run."""

import html
import re
import shlex
import shutil
from pathlib import Path

import pytest

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.results import Summary
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.former import current_settings
from acwm_core.training.run_folder import RunFolder, copy_of, run_to_write
from acwm_report.reproduce import commands
from acwm_zoo.shipped import MODEL_CARD, MODELS, folder, shipped
from tests.repository.test_docs import commands as commands_of
from tests.repository.test_docs import parse

QUICK_FIT = [
    *("+quick", "trainer.max_steps=2", "training.sample_every_n_steps=0"),
    *("training.validate_every_n_steps=2", "training.checkpoint_every_n_steps=2"),
    *("trainer.enable_progress_bar=false", "data.batch_size=1", "data.validation_episodes=1"),
]
QUICK_EVALUATION = [
    *("evaluation.episodes=2", "evaluation.frames=9", "evaluation.videos=0"),
    *("evaluation.counterfactual_episodes=1", "evaluation.perturbed_episodes=1"),
    *("evaluation.noise_floor_episodes=1", "evaluation.metrics=[psnr]"),
]


def printed(name):
    """The lines on the page of a shipped model's report."""
    run("report", name)
    page = (copy_of(name) / "report.html").read_text(encoding="utf-8")
    (text,) = re.findall(r"<h3>Reproduce it</h3>\s*<pre>(.*?)</pre>", page, re.DOTALL)
    return html.unescape(text).strip().splitlines()


def run(*words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == 0, words


def few(line, learns_motion):
    """The words of a line, with fewer episodes and steps; nothing else is changed."""
    acwm, command, *words = shlex.split(line)
    assert acwm == "acwm"
    if command == "generate":
        place = words.index("--episodes") + 1
        counts = zip((2, 2, 2), words[place].split(","), strict=True)
        words[place] = ",".join(str(min(most, int(count))) for most, count in counts)
        words += ["--workers", "0"]
    if command == "fit":
        words += QUICK_FIT
        words += ["objective.motion_steps=1"] if learns_motion else []
    if command == "evaluate":
        words += QUICK_EVALUATION
    return command, words


def quick_first(names):
    """All models, of which `.ci/run` takes two, of bodies with draws and of values."""
    others = [pytest.param(n, marks=pytest.mark.slow) for n in shipped() if n not in names]
    return [*(pytest.param(name, marks=pytest.mark.ci) for name in names), *others]


@pytest.mark.parametrize("name", quick_first(["push_cube_draws", "reacher"]))
def test_every_printed_command_runs(name, tmp_path, monkeypatch):
    """On little data, in few steps."""
    monkeypatch.chdir(tmp_path)
    lines = printed(name)
    recipe = RunFolder(folder(name)).recipe.read_text("utf-8")
    learns_motion = re.search(r"motion_steps: [1-9]", recipe) is not None
    given = [few(line, learns_motion) for line in lines]
    assert [command for command, _ in given][-3:] == ["fit", "evaluate", "report"]
    for command, words in given:
        run(command, *words)
    assert (copy_of(name).with_name(f"{name}-again") / "report.html").is_file()


@pytest.fixture
def asked(monkeypatch):
    """What the commands ask for: they write a card instead of data, and copy the shipped run."""
    made = {}

    def fill(out, wanted, *_, **__):
        out.mkdir(parents=True)
        wanted.write(out)
        made[out] = wanted
        return wanted

    def fit(recipe, out, **__):
        made["recipe"] = recipe
        name = out.name.removesuffix("-again")
        return shutil.copytree(folder(name), out)

    def evaluate_run(run, *, data, overrides, **__):
        made["tests"] = data or compose(RunFolder(run).recipe, []).data["path"]
        settings = compose(RunFolder(run).recipe, overrides).evaluation
        made["settings"] = EvaluationConfig(**settings).to_dict()

    monkeypatch.setattr("acwm_core.data.generate.fill", fill)
    monkeypatch.setattr("acwm_core.training.fit.fit", fit)
    monkeypatch.setattr("acwm_interventions.evaluate.evaluate_run", evaluate_run)
    monkeypatch.setattr("acwm_report.commands.print_summary", lambda summary: None)
    return made


@pytest.mark.parametrize("name", shipped())
def test_its_commands_ask_for_the_same_data_recipe_and_settings(name, tmp_path, monkeypatch, asked):
    monkeypatch.chdir(tmp_path)
    summary = Summary.read(folder(name))
    *lines, report = commands(run_to_write(name), summary)
    for line in lines:
        run(*shlex.split(line)[1:])
    assert report == f"acwm report {copy_of(name)}-again"
    assert asked["recipe"] == Recipe.from_yaml(RunFolder(folder(name)).recipe)
    wanted = current_settings(summary.provenance["evaluation"])
    assert {key: asked["settings"][key] for key in wanted} == wanted
    assert asked["settings"].keys() - wanted.keys() <= {"protocol"}
    card = DatasetCard.read(RunFolder(folder(name)).card)
    trained_on = asked[Path(asked["recipe"].data["path"])]
    for key in ("seed", "exploration", "shift", "options", "factors"):
        assert getattr(trained_on, key) == getattr(card, key), key
    assert trained_on.splits["train"] == card.splits["train"]
    tests, facts = asked[Path(asked["tests"])], summary.provenance["dataset"]
    assert (tests.environment.name, tests.seed) == (facts["environment"], facts["seed"])
    for split in ("ind_test", "ood_test"):
        assert tests.splits[split] == facts["episodes"][split]


@pytest.mark.parametrize("name", shipped())
def test_the_commands_of_its_card_are_read_and_make_its_data(name, tmp_path, monkeypatch, asked):
    monkeypatch.chdir(tmp_path)
    lines = commands_of(MODELS / name / MODEL_CARD)
    assert {f"acwm rollout {name}", f"acwm evaluate {name}"} <= {line.strip() for line in lines}
    for line in lines:
        parse(main, shlex.split(line)[1:], line)
    (generated,) = (shlex.split(line) for line in lines if line.startswith("acwm generate"))
    run(*generated[1:])
    recipe, card = (RunFolder(folder(name)).recipe, RunFolder(folder(name)).card)
    made, card = asked[Path(compose(recipe, []).data["path"])], DatasetCard.read(card)
    for key in ("seed", "exploration", "shift", "options", "factors"):
        assert getattr(made, key) == getattr(card, key), key
    assert made.splits["train"] == card.splits["train"]
    assert made.environment.frame_size == card.environment.frame_size


@pytest.mark.parametrize("name", shipped())
def test_the_advice_for_missing_test_data_makes_those_of_the_evaluation(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["evaluate", name])
    (command,) = re.findall(r"`(acwm generate .*?)`", capsys.readouterr().err)
    facts = Summary.read(folder(name)).provenance["dataset"]
    words = shlex.split(command)
    counts = words[words.index("--episodes") + 1].split(",")
    tests = [str(facts["episodes"][split]) for split in ("ind_test", "ood_test")]
    assert counts == ["0", *tests]
    assert words[words.index("--seed") + 1] == str(facts["seed"])
    assert words[2] == facts["environment"]
