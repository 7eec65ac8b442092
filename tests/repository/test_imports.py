"""The contracts of `.importlinter` cover every package; some modules must not be imported early."""

import configparser
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = {path.parent.name for path in (ROOT / "plugins").glob("*/__init__.py")}
HEAVY = ("torch", "lightning", "taichi", "mujoco", "pandas", "matplotlib", "pyarrow")
PLANS = [
    "show push_cube_small model=dit_s model.layers=4 trainer.precision=16-mixed codec=identity",
    "experiment ablations/conditioning_small --plan",
    "experiment planning --plan",
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


@pytest.mark.parametrize("words", ["--help", "list", "fit --help", "generate --help", *PLANS])
def test_these_commands_import_nothing_heavy(words):
    code = (
        "from acwm_core.cli import main\n"
        f"try: main({words.split()!r})\n"
        "except SystemExit as end: assert not end.code, end.code"
    )
    assert imported_by(code, *([] if words in PLANS else ["numpy"])) == []


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
