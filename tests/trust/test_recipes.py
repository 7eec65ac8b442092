"""Recipes of strangers: nothing that they name is imported, wherever a part of them came from."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import RecipeError
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.compose import read_recipe
from acwm_core.recipe.text import parse
from acwm_core.recipe.trust import refuse_code
from acwm_experiment.commands import COMMAND
from acwm_experiment.files import read_experiment

RUN = Path("tests/reference/first_release/run").resolve()
CODE = {"class_path": "evil.Callback", "init_args": {}}
METRIC = {"name": "torchmetrics", "metric_class": "evil.X"}


@pytest.fixture
def evil(tmp_path, monkeypatch):
    """A module that says whether it was imported, in the working directory and on the path."""
    (tmp_path / "evil.py").write_text("open('mark', 'w').close()\nclass X: pass\nCallback = X\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path / "mark"
    sys.modules.pop("evil", None)


@pytest.fixture
def run(tmp_path):
    return shutil.copytree(RUN, tmp_path / "run")


def said(*words):
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.stderr
    return result.stderr


def extended(path, base, **sections):
    """A recipe that extends another one; JSON is YAML."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"extends": [str(base)], **sections}))
    return path


def test_a_recipe_chooses_no_folder_to_write_to(tmp_path):
    flags = {"default_root_dir": str(tmp_path / "elsewhere")}
    recipe = extended(tmp_path / "mine.yaml", RUN / "recipe.yaml", trainer=flags)
    with pytest.raises(RecipeError, match="names a folder to write to"):
        compose(recipe)
    assert compose(recipe, [f"trainer.default_root_dir={flags['default_root_dir']}"])


@pytest.mark.parametrize(
    "sections",
    [
        {"trainer": {"callbacks": [CODE]}},
        {"trainer": {"callbacks": CODE}},
        {"trainer": {"callbacks": ["evil.Callback"]}},
        {"trainer": {"logger": {"class_path": "evil.Logger"}}},
        {"trainer": {"plugins": [CODE]}},
        {"trainer": {"profiler": "evil.Profiler"}},
        {"trainer": {"strategy": "evil.Strategy"}},
        {"trainer": {"callbacks": r'[{"class_path": "evil\u002eX"}]'}},  # Lightning parses it
        {"evaluation": {"metrics": [METRIC]}},
        {"evaluation": {"metrics": ["psnr"], "metric_options": {"torchmetrics": METRIC}}},
        {"evaluation": {"metric_options": {"fvd": {"detector": "program.pt"}}}},
        {"data": {"path": "evil:X"}},
    ],
)
def test_code_in_a_recipe_is_refused_wherever_it_stands(tmp_path, evil, sections):
    recipe = extended(tmp_path / "mine.yaml", RUN / "recipe.yaml", **sections)
    with pytest.raises(RecipeError, match="names code that would be executed"):
        compose(recipe)
    with pytest.raises(RecipeError, match="names code that would be executed"):
        refuse_code(read_recipe(recipe))
    refuse_code(read_recipe(recipe), sections=["codec", "model"])  # where it is not used
    assert not evil.exists()


def test_metrics_of_a_run_import_no_module(run, evil):
    """Not even to look whether it is one."""
    extended(run / "recipe.yaml", RUN / "recipe.yaml", evaluation={"metrics": [METRIC]})
    assert "evaluation.metrics[0].metric_class=evil.X" in said("evaluate", run, "--data", run)
    assert not evil.exists()


@pytest.mark.parametrize("way", ["no suffix", "no card", "overlay", "extends"])
def test_no_way_to_name_a_recipe_passes_the_rule(run, evil, way):
    trainer = {"max_steps": 3, "callbacks": [CODE]}
    words = ["fit", run / "recipe.yaml"]
    if way == "overlay":
        (run / "overlays").mkdir()
        (run / "overlays/small.yaml").write_text(json.dumps({"trainer": trainer}))
        words.append("+small")
    elif way == "extends":
        extended(run / "above/mine.yaml", "../recipe.yaml", trainer=trainer)
        words = ["fit", run / "above/mine"]
    else:
        extended(run / "recipe.yaml", RUN / "recipe.yaml", trainer=trainer)
        words = ["fit", run / "recipe"]
        if way == "no card":
            (run / "card.yaml").unlink()
    refusal = said(*words, "data.path=nowhere")
    assert "trainer.callbacks[0]" in refusal
    assert "names code that would be executed" in refusal
    trusted = said(*words, "data.path=nowhere", "--trust-recipe")
    assert "there is no dataset nowhere" in trusted  # so far it came
    assert "names code" in said(*words, "data.path=nowhere")  # and is not trusted for ever


def test_what_is_typed_counts(tmp_path):
    typed = f"trainer.callbacks={json.dumps([CODE])}"
    assert compose(RUN / "recipe.yaml", [typed]).trainer["callbacks"] == [CODE]
    recipe = extended(tmp_path / "mine.yaml", RUN / "recipe.yaml", trainer={"callbacks": CODE})
    with pytest.raises(RecipeError, match="names code"):  # half of it is a stranger's
        compose(recipe, ["trainer.callbacks.class_path=mine.Callback"])
    assert compose(recipe, trusted=True).trainer["callbacks"] == CODE
    sections = {**Recipe.from_yaml(RUN / "recipe.yaml").to_dict(), "trainer": {"callbacks": CODE}}
    assert Recipe.from_dict(sections).trainer["callbacks"] == CODE  # in Python


@pytest.mark.parametrize(
    "entries",
    [
        {"overrides": ["trainer.profiler=evil.Profiler"]},
        {"overrides": ["cost.function=evil:X"]},
        {"overrides": ["evaluation.metrics=[{name: torchmetrics, metric_class: evil.X}]"]},
        {"plans": {"a": {"task": "place", "overrides": ["cost.function=evil:X"]}}},
    ],
)
def test_an_experiments_file_names_no_code(tmp_path, evil, entries):
    file = tmp_path / "table.yaml"
    file.write_text(json.dumps({"rows": {"a": {"b": "push_cube_small"}}, **entries}))
    with pytest.raises(RecipeError, match="names code that would be executed"):
        read_experiment(file)
    assert not evil.exists()


def test_steps_of_an_experiment_import_nothing_from_the_working_folder(tmp_path):
    (tmp_path / "yaml.py").write_text("open('mark', 'w').close()\n")
    done = subprocess.run([*COMMAND, "--version"], cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "mark").exists()


def test_no_child_imports_from_the_working_folder(tmp_path):
    """Workers too: Python starts them by a command that would look there first."""
    script, folder = tmp_path / "script/run.py", tmp_path / "folder"
    for place in (script.parent, folder):
        place.mkdir()
    (folder / "multiprocessing.py").write_text("open('mark', 'w').close()\n")
    script.write_text(
        "import contextlib, multiprocessing, sys, acwm_core\n"
        "if __name__ == '__main__':\n"
        "    if 'safe' in sys.argv:\n"
        "        sys.argv = ['acwm', '--version']\n"
        "        with contextlib.suppress(SystemExit):\n"
        "            acwm_core.main()\n"
        "    worker = multiprocessing.get_context('spawn').Process(target=print)\n"
        "    worker.start(), worker.join()\n"
    )
    for how in ("safe", "unsafe"):
        subprocess.run([sys.executable, script, how], cwd=folder, capture_output=True)
        assert (folder / "mark").exists() == (how == "unsafe")


def test_usual_flags_are_no_code(tmp_path):
    flags = {"devices": "0,1", "strategy": "ddp", "precision": "bf16-mixed"}
    flags |= {"gradient_clip_val": "0.5", "max_time": {"hours": 1}}
    metrics = ["psnr", "torchmetrics.image.SpectralAngleMapper"]  # of a library that is installed
    recipe = extended(
        tmp_path / "mine.yaml", RUN / "recipe.yaml", trainer=flags, evaluation={"metrics": metrics}
    )
    assert compose(recipe).trainer["max_time"] == {"hours": 1}


@pytest.mark.parametrize(
    "text", ["!!python/object/apply:os.system [id]", "x: !!int y", "? [a]\n: 1", "x: [", "\tx: 1"]
)
def test_yaml_makes_no_objects(text):
    with pytest.raises(RecipeError) as raised:
        parse(text, "the recipe")
    assert "\n" not in str(raised.value)
