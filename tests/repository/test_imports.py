"""The contracts of `.importlinter` cover every package; some modules must not be imported early."""

import configparser
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLUGINS = {path.parent.name for path in (ROOT / "plugins").glob("*/__init__.py")}
HEAVY = ("torch", "lightning", "taichi", "mujoco", "pandas", "matplotlib", "pyarrow", "numpy")
MISSPELT = [
    "show push_cube_smal",
    "show push_cube_small modle=dit_s",
    "show push_cube_small model=dit_z",
    "show push_cube_small training.learning_rat=1",
    "show push_cube_small data.batch_size=x",
    "show push_cube_small evaluation.metrics=[psrn]",
    "show push_cube_small trainer.max_step=1",
    "fit push_cube_small training.sed=3",
    "evaluate tests/reference/first_release/run evaluation.step=3",
]
TOLD = ["--help", "list", "fit --help", "generate --help", "plan --help"]
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


def imported_by(*codes):
    """The names in `HEAVY` that each has imported, run one after another in a fresh interpreter."""
    program = (
        "import json, sys\n"
        "found, heavy, codes = {}, set(json.loads(sys.argv[1])), json.loads(sys.argv[2])\n"
        "for code in codes:\n"
        "    exec(code)\n"
        "    found[code] = sorted(heavy & sys.modules.keys())\n"
        "    heavy -= sys.modules.keys()\n"
        "print('heavy:', json.dumps(found))"
    )
    command = [sys.executable, "-c", program, json.dumps(HEAVY), json.dumps(codes)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.rpartition("heavy:")[2])


def of_command(words, exit_code):
    return (
        "from acwm_core.cli import main\n"
        f"try: main({words.split()!r})\n"
        f"except SystemExit as end: assert (end.code or 0) == {exit_code}, end.code"
    )


def test_commands_that_only_tell_import_nothing_heavy_nor_numpy():
    found = imported_by(*(of_command(words, 0) for words in TOLD))
    assert {code: heavy for code, heavy in found.items() if heavy} == {}


def test_wrong_names_light_values_and_early_modules_import_nothing_heavy():
    wrong = [of_command(words, 2) for words in MISSPELT]
    modules = [f"import {name}" for name in ("acwm", *(f"acwm_core.{each}" for each in MODULES))]
    found = imported_by(*wrong, *modules)
    assert {code: heavy for code, heavy in found.items() if heavy not in ([], ["numpy"])} == {}


def test_only_training_imports_lightning_and_reports_no_torch():
    page = "import acwm_report.page"
    others = "import acwm_core.training.run, acwm_core.evaluation.evaluate, acwm_core.cli"
    others += ", acwm_dream.rollout"
    found = imported_by(page, others)
    assert "torch" not in found[page]
    assert "torch" in found[others]  # so that it would be noticed
    assert "lightning" not in {*found[page], *found[others]}
