"""Recipes of strangers: bounded, and no code of theirs runs from a run folder unasked."""

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.errors import RecipeError
from acwm_core.model.build import build_world_model
from acwm_core.recipe import compose
from acwm_core.recipe.text import parse

RUN = Path("tests/reference/first_release/run")
BOMB = "a0: &a0 [x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (BOMB, "it has more than"),
        ("a: &a [*a]", "contains itself"),
        ("[" * 3000 + "]" * 3000, "levels deep"),
        ("{a: " * 3000 + "}" * 3000, "levels deep"),
        ("\n".join(f"k{n}: 1" for n in range(60_000)), "more than"),
        ("x: " + "y" * 2**21, "more than"),
        ("x: " + "1:" * 3000 + "1", "a number of"),
        ("x: " + "9" * 5000, "a number of"),
        ('x: "\\e]0;evil\\a"', "control characters"),
        ("!!python/object/apply:os.system [id]", "python"),
        ("x: !!binary aGk=", "binary"),
        ("x: !!int y", "ValueError"),
        ("? [a]\n: 1", "unhashable"),
    ],
)
def test_yaml_is_bounded(text, why):
    with pytest.raises(RecipeError, match=why) as raised:
        parse(text, "the recipe")
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 300


def test_many_keys_and_aliases_are_fine():
    assert len(parse("\n".join(f"k{n}: 1" for n in range(3000)), "x")) == 3000
    found = parse("a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}", "x")
    assert found["c"] == {"x": 1, "y": 2}


@pytest.mark.parametrize(
    "change",
    ["model.layers=1000000000", "model.width=6000000 model.heads=1", "model.layers=100000"],
)
def test_models_that_no_machine_holds_are_refused(change):
    recipe = compose(RUN / "recipe.yaml", change.split())
    card = DatasetCard.read(RUN / "card.yaml").environment
    with pytest.raises(RecipeError, match="is too large as the recipe has it"):
        build_world_model(recipe, card)


CODE = {"class_path": "os.system", "init_args": {"command": "id"}}


@pytest.mark.parametrize(
    "flags",
    [
        {"callbacks": [CODE]},
        {"callbacks": CODE},
        {"callbacks": "evil.Callback"},
        {"callbacks": ["evil.Callback"]},
        {"logger": {"class_path": "evil.Logger"}},
        {"plugins": [{"class_path": "evil.Plugin"}]},
        {"profiler": "evil.Profiler"},
    ],
)
def test_a_runs_recipe_names_no_code(tmp_path, flags):
    run = shutil.copytree(RUN, tmp_path / "run")
    text = (run / "recipe.yaml").read_text()
    trainer = json.dumps({"trainer": {"max_steps": 3, **flags}})
    (run / "stranger.yaml").write_text(f"extends: [recipe.yaml]\n{trainer[1:-1]}\n")
    assert "callbacks" not in text
    arguments = ["fit", str(run / "stranger.yaml"), "data.path=nowhere"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "names code that would be executed" in result.stderr
    assert "Traceback" not in result.stderr
    trusted = CliRunner().invoke(main, [*arguments, "--trust-recipe"])
    assert "there is no dataset nowhere" in trusted.stderr  # so far it came
    own = tmp_path / "mine.yaml"
    shutil.copy(run / "stranger.yaml", own)
    own.write_text(own.read_text().replace("recipe.yaml", str(run / "recipe.yaml")))
    assert (
        "there is no dataset nowhere"
        in CliRunner().invoke(main, ["fit", str(own), *arguments[2:]]).stderr
    )


def test_usual_flags_are_no_code(tmp_path):
    run = shutil.copytree(RUN, tmp_path / "run")
    flags = "max_steps: 3, devices: [0], strategy: ddp, max_time: '00:00:01:00'"
    (run / "mine.yaml").write_text(f"extends: recipe.yaml\ntrainer: {{{flags}}}\n")
    result = CliRunner().invoke(main, ["fit", str(run / "mine.yaml"), "data.path=nowhere"])
    assert "there is no dataset nowhere" in result.stderr
