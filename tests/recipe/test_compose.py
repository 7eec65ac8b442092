"""Files, `extends` and words to one dict."""

import math
from pathlib import Path

import pytest
import yaml

from acwm_core.errors import RecipeError
from acwm_core.recipe.compose import merge, parse_override, read_recipe
from acwm_core.recipe.text import dump, parse


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    files = {
        "root.yaml": "codec: {name: compact, weights: a}\nobjective: {shift: 5, steps: 3}\n",
        "parts/model.yaml": "model: dit_s\nobjective: {steps: 4}\n",
        "own.yaml": "extends: [root.yaml, parts/model.yaml]\nobjective: {prediction: clean}\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_extends_are_merged_deeply_and_in_order(folder: Path) -> None:
    assert read_recipe(folder / "own.yaml") == {
        "codec": {"name": "compact", "weights": "a"},
        "model": {"name": "dit_s"},
        "objective": {"shift": 5, "steps": 4, "prediction": "clean"},
    }


def test_extends_finds_siblings_before_packaged_recipes(folder: Path) -> None:
    (folder / "base.yaml").write_text("codec: identity\n")
    (folder / "own.yaml").write_text("extends: base.yaml\n")
    assert read_recipe(folder / "own.yaml") == {"codec": {"name": "identity"}}
    (folder / "base.yaml").unlink()
    assert "conditioner" in read_recipe(folder / "own.yaml")  # the one that comes with acwm


def test_a_name_without_suffix_is_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert read_recipe("parts/model") == read_recipe(folder / "parts" / "model.yaml")


def test_a_part_that_changes_its_name_drops_its_parameters(folder: Path) -> None:
    changed = read_recipe(folder / "own.yaml", ["codec=identity"])
    assert changed["codec"] == {"name": "identity"}
    same = read_recipe(folder / "own.yaml", ["codec=compact"])
    assert same["codec"] == {"name": "compact", "weights": "a"}
    (folder / "other.yaml").write_text("extends: [own.yaml]\ncodec: {name: identity, fold: 4}\n")
    assert read_recipe(folder / "other.yaml")["codec"] == {"name": "identity", "fold": 4}


def test_words_do_not_depend_on_their_order(folder: Path) -> None:
    words = ["codec.fold=4", "codec=identity"]
    forwards = read_recipe(folder / "own.yaml", words)
    assert forwards == read_recipe(folder / "own.yaml", words[::-1])
    assert forwards["codec"] == {"fold": 4, "name": "identity"}


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("objective.shift=1e-4", 1e-4),
        ("objective.shift=-2.5E+3", -2500.0),
        ("objective.shift=.5e1", 5.0),
        ("objective.shift=5", 5),
        ("objective.shift=null", None),
        ("objective.shift=[1, 2]", [1, 2]),
        ("objective.shift={a: 1}", {"a": 1}),
        ("objective.shift=2024-01-01", "2024-01-01"),
        ("objective.shift=a=b", "a=b"),
        ("objective.shift=010", 10),  # in YAML 1.1: 8
        ("objective.shift=0o10", 8),
        ("objective.shift=12:30", "12:30"),  # 750
        ("objective.shift=10:00:00:00", "10:00:00:00"),
        ("objective.shift=no", "no"),  # false
        ("objective.shift='1e-4'", "1e-4"),
        ("objective.shift=", None),
    ],
)
def test_values_of_words_are_yaml(word: str, expected: object) -> None:
    assert parse_override(word) == {"objective": {"shift": expected}}


def test_what_is_written_is_read_back_by_both_versions_of_yaml() -> None:
    texts = [
        "010",
        "12:30",
        "yes",
        "no",
        "on",
        "0o17",
        "1e4",
        "1_0",
        "~",
        "=",
        "<<",
        "0x1f",
        "0b1",
        ".inf",
        "2026-01-01",
        "null",
    ]
    values = {"texts": [*texts, ""], "numbers": [10, -1, 1e-7, 1.5, 1e300, math.inf], "truth": True}
    assert parse(dump(values), "text") == values
    assert yaml.safe_load(dump(values)) == values


def test_a_part_may_be_written_out_in_a_word() -> None:
    assert parse_override("model={name: dit_s, layers: 2}") == {
        "model": {"name": "dit_s", "layers": 2}
    }
    assert parse_override("trainer.strategy.class_path=x.Y") == {
        "trainer": {"strategy": {"class_path": "x.Y"}}
    }


@pytest.mark.parametrize("word", ["model", "=3", "model.=3", ".layers=3", "model..layers=3"])
def test_malformed_words_are_refused(word: str) -> None:
    with pytest.raises(RecipeError, match="is not an override"):
        parse_override(word)
    with pytest.raises(RecipeError, match="not valid YAML"):
        parse_override("objective.shift=[1")


def test_circles_are_refused(folder: Path) -> None:
    (folder / "a.yaml").write_text("extends: [b.yaml]\n")
    (folder / "b.yaml").write_text("extends: [a.yaml]\n")
    with pytest.raises(RecipeError, match=r"circle: a\.yaml → b\.yaml → a\.yaml"):
        read_recipe(folder / "a.yaml")


def test_a_replaced_parameter_may_be_one_that_a_new_objective_kept(overlaid: Path) -> None:
    (overlaid / "mine.yaml").write_text("extends: own.yaml\nobjective: next_frame\n")
    assert read_recipe(overlaid / "mine.yaml")["objective"]["prediction"] == "clean"
    assert read_recipe(overlaid / "mine.yaml", ["+tiny"])["objective"]["prediction"] == "velocity"


def test_missing_files_name_the_nearest(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "a.yaml").write_text("extends: [rot.yaml]\n")
    with pytest.raises(RecipeError, match=r"'rot\.yaml'; did you mean 'root\.yaml'"):
        read_recipe(folder / "a.yaml")
    with pytest.raises(RecipeError, match=r"did you mean '.*/own\.yaml'"):
        read_recipe(folder / "own_.yaml")
    monkeypatch.chdir(folder)
    with pytest.raises(RecipeError, match="did you mean 'push_cube_small'"):
        read_recipe("push_cube_smal")


@pytest.fixture
def overlaid(folder: Path) -> Path:
    (folder / "overlays").mkdir()
    files = {
        "tiny": "replace:\n"
        "  model: {dit_s: {name: dit_xs, layers: 1}, dit_m: dit_s}\n"
        "  codec: {wan: compact}\n"
        "  objective.prediction: {clean: velocity}\n"
        "  data.path: {x: y}\n"
        "objective: {steps: 1}\n",
        "slow": "extends: [quick_part.yaml]\nobjective: {shift: 9}\n",
        "quick_part": "objective: {steps: 2}\n",
    }
    for name, text in files.items():
        (folder / "overlays" / f"{name}.yaml").write_text(text)
    return folder


def test_overlays_replace_what_they_list_and_lay_the_rest_over(overlaid: Path) -> None:
    assert read_recipe(overlaid / "own.yaml", ["+tiny"]) == {
        "codec": {"name": "compact", "weights": "a"},  # not listed
        "model": {"name": "dit_xs", "layers": 1},
        "objective": {"shift": 5, "steps": 1, "prediction": "velocity"},
    }


def test_overlays_come_in_order_and_words_over_them(overlaid: Path) -> None:
    own = overlaid / "own.yaml"
    assert read_recipe(own, ["+tiny", "+slow"])["objective"]["steps"] == 2
    assert read_recipe(own, ["+slow", "+tiny"])["objective"] == {
        "shift": 9,
        "steps": 1,
        "prediction": "velocity",
    }
    words = ["objective.steps=7", "model=dit_m", "+tiny"]
    changed = read_recipe(own, words)
    assert changed == read_recipe(own, words[::-1])
    assert (changed["objective"]["steps"], changed["model"]) == (7, {"name": "dit_m"})


def test_a_recipe_may_extend_an_overlay(overlaid: Path) -> None:
    (overlaid / "twin.yaml").write_text("extends: [own.yaml, overlays/tiny.yaml]\n")
    own = read_recipe(overlaid / "own.yaml", ["+tiny"])
    assert read_recipe(overlaid / "twin.yaml") == own


def test_unknown_overlays_name_the_nearest(overlaid: Path) -> None:
    with pytest.raises(RecipeError, match=r"no overlay '\+tny'; did you mean '\+tiny'"):
        read_recipe(overlaid / "own.yaml", ["+tny"])
    with pytest.raises(RecipeError, match=r"no overlay '\+smal'; did you mean '\+small'"):
        read_recipe(overlaid / "own.yaml", ["+smal"])  # one that comes with acwm
    with pytest.raises(RecipeError, match=r"no overlay '\+'"):
        read_recipe(overlaid / "own.yaml", ["+"])


def test_overlays_meet_recipes_without_what_they_replace(overlaid: Path) -> None:
    (overlaid / "odd.yaml").write_text("objective:\ncodec: [1]\ndata: text\nmodel: {layers: 3}\n")
    odd = read_recipe(overlaid / "odd.yaml", ["+tiny"])
    assert (odd["model"], odd["data"], odd["objective"]) == ({"layers": 3}, "text", {"steps": 1})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("replace: [model]\n", "must list replacements"),
        ("replace: {model: dit_s}\n", "must list replacements"),
        ("- a\n- b\n", "is not a recipe"),
        ("just text", "is not a recipe"),
        ("objective: {shift: 5\n", "not valid YAML"),
        (f"seed: {'9' * 5000}\n", "not valid YAML"),  # more digits than Python reads
        ("objective: {}\nmodel: dit_s\nobjective: {}\n", "'objective' is given twice"),
        ("extends: {a: b}\n", "must be a list of recipe files"),
        ("extends: [3]\n", "must be a list of recipe files"),
    ],
)
def test_files_that_are_no_recipes_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(RecipeError, match=message):
        read_recipe(tmp_path / "bad.yaml")


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_bytes(b"\xff\xfe\x00model")
    with pytest.raises(RecipeError, match="cannot read the recipe"):
        read_recipe(tmp_path / "bad.yaml")


def test_merging_changes_neither_side() -> None:
    base, changes = {"objective": {"shift": 1}}, {"objective": {"steps": 2}}
    assert merge(base, changes) == {"objective": {"shift": 1, "steps": 2}}
    assert (base, changes) == ({"objective": {"shift": 1}}, {"objective": {"steps": 2}})
