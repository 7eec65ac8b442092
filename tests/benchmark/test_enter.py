"""The participant on the page runs as it stands, without acwm, and enters."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from acwm_benchmark.score import score_predictions

PAGE = Path(__file__).parents[2] / "docs" / "enter.md"


@pytest.mark.ci
def test_the_page_is_short_and_its_program_enters(tasks, truth, tmp_path):
    text = PAGE.read_text()
    assert len(text.splitlines()) <= 60
    (code,) = re.findall(r'^```python title="enter.py"\n(.*?)^```', text, re.M | re.S)
    imported = set(re.findall(r"^(?:import|from) (\w+)", code, re.M))
    assert imported == {"json", "pathlib", "imageio", "numpy"}
    (tmp_path / "enter.py").write_text(code)
    (tmp_path / "tasks").symlink_to(tasks)
    subprocess.run([sys.executable, "enter.py"], cwd=tmp_path, check=True)
    found = score_predictions(
        tmp_path / "predictions", tasks, data=truth, out=tmp_path / "scores", progress=False
    )["slide"]
    assert found.provenance["entry"]["name"] == "Stands still"
    for split in found.splits.values():  # the row of the same prediction
        rows = split.scores.rows
        for metric, score in rows["copy"].items():
            if score.value is not None:
                assert rows["model"][metric].value == pytest.approx(score.value, rel=1e-9)
        assert split.counterfactual.rows["model"]["response"].value == pytest.approx(0)
