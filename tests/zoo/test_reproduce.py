"""The commands under "Reproduce it" of every model that ships run, on little data, in few steps."""

import html
import re
import shlex

import pytest

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.evaluation.results import Summary
from acwm_core.training.run_folder import RunFolder, copy_of
from acwm_zoo.shipped import folder, shipped

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


@pytest.mark.ci
@pytest.mark.parametrize("name", shipped())
def test_every_printed_command_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = printed(name)
    recipe = RunFolder(folder(name)).recipe.read_text("utf-8")
    learns_motion = re.search(r"motion_steps: [1-9]", recipe) is not None
    commands = [few(line, learns_motion) for line in lines]
    assert [command for command, _ in commands][-3:] == ["fit", "evaluate", "report"]
    for command, words in commands:
        run(command, *words)
    assert (copy_of(name).with_name(f"{name}-again") / "report.html").is_file()
    card = DatasetCard.read(RunFolder(folder(name)).card)
    made = {path.parent: DatasetCard.read(path) for path in (tmp_path / "data").glob("*/card.yaml")}
    assert any(  # the data that it was trained on, and not those that it was tested on
        (each.seed, each.exploration, each.shift) == (card.seed, card.exploration, card.shift)
        and each.splits["train"]
        for each in made.values()
    )


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
