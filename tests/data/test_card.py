"""The dataset card: round trip, what is refused, differences by name."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from acwm_core.data.card import DatasetCard
from acwm_core.errors import DataError

EARLIER = Path(__file__).parents[1] / "reference" / "second_release" / "data"


def test_a_card_comes_back_from_its_file(square_data, tmp_path):
    card = DatasetCard.read(square_data)
    card.write(tmp_path)
    assert DatasetCard.read(tmp_path) == card
    assert DatasetCard.read(tmp_path / "card.yaml") == card
    assert DatasetCard.read(str(square_data)).environment.factors[0].ood == (90,)


def test_a_missing_dataset_says_how_to_make_one(tmp_path):
    missing = tmp_path / "nowhere"
    with pytest.raises(DataError, match=f"no dataset in {missing}: make one with `acwm generate"):
        DatasetCard.read(missing)


def test_a_card_of_a_later_layout_is_refused(square_data, tmp_path):
    values = yaml.safe_load((square_data / "card.yaml").read_text())
    (tmp_path / "card.yaml").write_text(yaml.safe_dump({**values, "format": 2}))
    with pytest.raises(DataError, match="layout version 2, this acwm reads 1"):
        DatasetCard.read(tmp_path)


def test_a_card_of_an_earlier_release_is_that_of_the_same_data():
    push_cube = pytest.importorskip("acwm_rigid.push_cube").PushCube
    there = DatasetCard.read(EARLIER)
    assert {each.kind for each in there.environment.state} == {"value"}
    now = replace(there, environment=push_cube(size=64).card)
    assert there.differences(now) == now.differences(there) == []
    assert there.identity == now.identity
    assert now.environment.completed_by(there.environment) == now.environment
    assert there.environment.completed_by(now.environment).camera == now.environment.camera


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "place"},
        {"kind": 3},
        {"symmetry": "cube"},
        {"height": "0.1"},
        {"instances": "square"},
        {"present": "there"},
    ],
)
def test_a_wrong_declaration_in_a_card_that_was_edited_is_refused(square_data, tmp_path, wrong):
    values = yaml.safe_load((square_data / "card.yaml").read_text())
    values["environment"]["state"][0] |= wrong
    (tmp_path / "card.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(DataError, match="is not a dataset card"):
        DatasetCard.read(tmp_path)


def test_differences_are_named(square_data):
    card = DatasetCard.read(square_data)
    assert card.differences(card) == []
    faster = replace(
        card, environment=replace(card.environment, fps=20), seed=5, splits={"train": 3}
    )
    assert card.differences(faster) == [
        "environment.fps is 10 there, 20 now",
        "seed is 0 there, 5 now",
        "splits.train is 11 there, 3 now",
    ]
    other_statistics = replace(card, actions={}, splits={})
    assert card.differences(other_statistics) == []
