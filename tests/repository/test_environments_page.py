"""docs/environments.md says what the cards of all environments say, and shows all of them."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
REBUILD = "run: python docs/build_environments.py"


@pytest.fixture(scope="module")
def text():
    for simulator in ("mujoco", "pybullet", "taichi"):
        pytest.importorskip(simulator)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        import environments_text

        yield environments_text


def test_the_page_says_what_the_cards_say(text):
    assert (DOCS / "environments.md").read_text() == text.page(text.cards()), REBUILD


def test_its_pictures_are_all_there_and_no_others():
    shown = set(re.findall(r"\]\((environments/[^)]+)\)", (DOCS / "environments.md").read_text()))
    kept = {f"environments/{path.name}" for path in (DOCS / "environments").iterdir()}
    assert shown == kept, REBUILD
    assert sum((DOCS / name).stat().st_size for name in kept) <= 3 * 2**20


def test_every_world_has_its_tables(text):
    found = text.cards()
    page = text.page(found)
    for name, card in found.items():
        assert re.search(rf"^##+ {name}$", page, re.M)
        for factor in card.factors:
            assert factor.description in page
        for field in card.state:
            assert f"`{field.name}`" in page
        for action, unit in zip(card.action.names, card.action.units, strict=True):
            assert f"| `{action}` | {unit or '–'} |" in page
