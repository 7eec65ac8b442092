"""The public names of core are those of docs/reference/public-names.txt."""

import importlib.util
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "docs/build_public_names.py"


def build():
    spec = importlib.util.spec_from_file_location("build_public_names", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_others_may_rely_on_is_written_down():
    names = build()
    known, now = (set(text.splitlines()) for text in (names.FILE.read_text(), names.text()))
    assert known == now, "see its first lines; remake it by `python docs/build_public_names.py`"


def test_names_of_every_sort_are_found():
    listed = set(build().text().splitlines())
    assert {
        "acwm_core.errors:AcwmError",
        "acwm_core.evaluation.study:Study.count_rows",
        "acwm_core.training.config:TrainingConfig.learning_rate",
        "acwm_core.env.episode:SPLITS",
        "training.learning_rate",
        "objective=diffusion_forcing objective.shift",
        "model=NAME",
    } <= listed
    assert not any("._" in name or ":_" in name for name in listed)
