"""The contracts of `.importlinter` cover every package; some modules must not be imported early."""

import configparser
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = {path.parent.name for path in (ROOT / "plugins").glob("*/__init__.py")}
HEAVY = ("torch", "lightning", "taichi", "mujoco", "pandas", "matplotlib", "pyarrow")
MISSPELT = [
    "show push_cube_smal",
    "show push_cube_small modle=dit_s",
    "show push_cube_small model=dit_z",
    "show push_cube_small training.learning_rat=1",
    "show push_cube_small data.batch_size=x",
    "show push_cube_small evaluation.metrics=[psrn]",
    "show push_cube_small trainer.max_step=1",
]
MODULES = ["recipe", "plugins", "env.environment", "env.episode", "env.task", "training.config"]


def contracts():
    parser = configparser.ConfigParser()
    parser.read(ROOT / ".importlinter")
    return {name: dict(parser[name]) for name in parser.sections()}


def test_the_contracts_know_every_plugin():
    found = contracts()
    assert set(found["importlinter"]["root_packages"].split()) == {"acwm_core", *PLUGINS}
    core = found["importlinter:contract:core-knows-no-plugin"]
    assert set(core["forbidden_modules"].split()) == PLUGINS
    ranks = found["importlinter:contract:tools"]["layers"]
    assert set(ranks.replace("|", " ").replace(":", " ").split()) == {"acwm_core", *PLUGINS}


def imported_by(code, *more):
    """Those of `HEAVY` and `more` that a fresh interpreter has imported after running `code`."""
    names = {*HEAVY, *more}
    report = f"import sys; print('heavy:', *({names!r} & sys.modules.keys()))"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return done.stdout.rpartition("heavy:")[2].split()


def imported_by_command(words, exit_code, *more):
    return imported_by(
        "from acwm_core.cli import main\n"
        f"try: main({words.split()!r})\n"
        f"except SystemExit as end: assert (end.code or 0) == {exit_code}, end.code",
        *more,
    )


@pytest.mark.parametrize("words", ["--help", "list", "fit --help", "generate --help"])
def test_these_commands_import_nothing_heavy(words):
    assert imported_by_command(words, 0, "numpy") == []


@pytest.mark.parametrize("words", MISSPELT)
def test_a_wrong_name_or_light_value_is_told_without_heavy_imports(words):
    assert imported_by_command(words, 2) == []


@pytest.mark.parametrize("module", MODULES)
def test_these_modules_import_nothing_heavy(module):
    assert imported_by(f"import acwm_core.{module}") == []


def test_only_training_imports_lightning_and_reports_no_torch():
    assert "torch" not in imported_by("import acwm_report.page")
    code = "import acwm_core.training.run, acwm_core.evaluation.evaluate, acwm_core.cli"
    assert "lightning" not in imported_by(f"{code}, acwm_dream.rollout")


def test_heavy_imports_would_be_noticed():
    assert imported_by("import acwm_core.model.codec") == ["torch"]


def test_acwm_itself_imports_nothing_heavy():
    assert imported_by("import acwm") == []
