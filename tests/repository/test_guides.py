"""Blocks of the guides below `<!-- run -->` are run, with the files that the page shows."""

import re
from pathlib import Path

import pytest

from tests.scripts import run_script

DOCS = Path(__file__).parents[2] / "docs"
FILE = re.compile(r'^```python title="(\w+\.py)"\n(.*?)^```', re.M | re.S)
RUN = re.compile(r"^<!-- run -->\n```python\n(.*?)^```", re.M | re.S)
GUIDES = [path for path in sorted(DOCS.glob("*.md")) if "<!-- run -->" in path.read_text()]


def test_every_mark_stands_above_a_block():
    assert GUIDES
    for guide in GUIDES:
        text = guide.read_text()
        assert len(RUN.findall(text)) == text.count("<!-- run -->"), guide.name


@pytest.mark.ci
@pytest.mark.parametrize("guide", GUIDES, ids=[guide.stem for guide in GUIDES])
def test_the_code_of_a_guide_runs(guide, tmp_path):
    """In a process of its own, as a reader who copies block after block into one script has it."""
    text = guide.read_text()
    for name, code in FILE.findall(text):
        (tmp_path / name).write_text(code)
    script = tmp_path / "script.py"
    script.write_text("\n".join(RUN.findall(text)))
    run_script(script, tmp_path, ACWM_CACHE=str(tmp_path / "cache"))
