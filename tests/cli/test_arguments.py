"""Folders named on the command line: known by what is in them, the nearest one suggested."""

from pathlib import Path

import pytest

from acwm_core.cli.arguments import DATASET, RUN, ExistingFolder
from acwm_core.errors import DataError


def refusal(kind: ExistingFolder, path: Path) -> str:
    with pytest.raises(DataError) as error:
        kind.convert(path, None, None)
    return str(error.value)


@pytest.mark.parametrize(("kind", "marker"), [(RUN, "recipe.yaml"), (DATASET, "card.yaml")])
def test_a_folder_is_known_by_its_file(kind: ExistingFolder, marker: str, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "mind").mkdir()
    assert f"it has no {marker}" in refusal(kind, mine)
    assert "make one with `acwm" in refusal(kind, tmp_path / "min")
    (mine / marker).touch()
    assert kind.convert(str(mine), None, None) == mine
    assert refusal(kind, tmp_path / "min").endswith(f"did you mean {str(mine)!r}?")
