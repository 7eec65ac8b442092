"""docs/reference/environments.md lists all environments; the site says all that their cards say."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "reference" / "environments.md"


@pytest.fixture(scope="module")
def text():
    for simulator in ("mujoco", "pybullet", "taichi"):
        pytest.importorskip(simulator)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        import environments_text

        yield environments_text


@pytest.fixture(scope="module")
def found(text):
    return text.cards()


def test_the_page_has_the_table_and_the_place_of_the_sections(text, found):
    page = PAGE.read_text()
    assert text.overview(found) in page, f"write into it:\n{text.overview(found)}"
    assert page.endswith("<!-- generated: environments -->\n")


def test_its_pictures_are_all_there_and_no_others(text, found):
    shown = PAGE.read_text() + text.sections(found)
    kept = {f"environments/{path.name}" for path in (DOCS / "environments").iterdir()}
    assert set(re.findall(r"\]\(\.\./(environments/[^)]+)\)", shown)) == kept, "run: make docs"
    assert sum((DOCS / name).stat().st_size for name in kept) <= 3 * 2**20
