"""The pages about one's own data are walked: every command and the Python in them, in order."""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from tests.formats import release
from tests.formats.corpus import arrays, files, logs
from tests.formats.corpus.cases import Case, three
from tests.formats.test_command_line import QUICK, QUICK_EVALUATION
from tests.formats.test_from_lerobot import REFERENCE

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [DOCS / "your-own-data.md", DOCS / "reference" / "formats.md"]
TAKES = Case("takes", three(), names=("take 1", "take 2", "take 3"), column="time")
LARGE = replace(TAKES, size=(96, 128))
"""As a camera takes them: larger than a small model's frames."""


ELSEWHERE = (
    *("data import rlds", "data import videos films", "data label"),
    *("fit small data.path=data/latent", "play"),
)
"""Commands on data that only their own tests have."""


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with what the page speaks of."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(REFERENCE / "video", "my_robot")
    release.environment(Path("release/kinematics/reacher"), length=5)
    for folder, write in (("takes", files.videos), ("logs", logs.in_ros2)):
        Path(folder).mkdir()
        write(Path(folder), LARGE if folder == "takes" else TAKES)
    for write, name in (
        (arrays.robomimic, "demo.hdf5"),
        (arrays.mapped, "mine.h5"),
        (arrays.replay, "pusht.zarr"),
        (arrays.minari, "door"),
    ):
        write(Path(), TAKES)[0].rename(name)
    Path("recordings").mkdir()
    for index in range(4):
        frames, actions = release.moving_square(np.random.default_rng(index), 7, (32, 32))
        np.savez(f"recordings/{index}.npz", video=frames, actions=actions, gripper=np.ones((7, 1)))
    return tmp_path


@pytest.mark.ci
def test_every_step_works(desk):
    text = "".join(page.read_text() for page in PAGES)
    commands = re.findall(r"^ {4}acwm (.*)$", text, re.M)
    commands = [command for command in commands if not command.startswith(ELSEWHERE)]
    assert len(commands) == 17
    for line in commands:
        words = shlex.split(line)
        words += QUICK if words[0] == "fit" else ()
        words += ["--workers", "0"] if words[:2] == ["data", "import"] else []
        words += QUICK_EVALUATION if words[0] == "evaluate" else ()
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, f"{line}: {result.output}"
    for code in re.findall(r"^```python\n(.*?)^```", text, re.M | re.S):
        exec(compile(code, "walk", "exec"), {"__name__": "walk"})
    made = {path.parent.name for path in Path("data").rglob("card.yaml")}
    shown = set(re.findall(r"--out data/(\w+)", text))
    elsewhere = {"published", "bridge", "films", "labelled", "latent"}
    assert made == {*shown, "arm", "cubes", "reacher"} - elsewhere
    assert DatasetCard.read("data/arm").splits == {"train": 2, "ind_test": 2}
    assert Path("runs/small/report.html").is_file()
