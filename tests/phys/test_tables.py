"""The paper's figures, and how a run's stand beside them."""

import dataclasses
import math
import re
from collections import defaultdict

import pytest

from acwm_core.evaluation.protocol import published_for, published_tables
from acwm_core.evaluation.results import Summary
from acwm_core.recipe import compose
from acwm_report.terminal import about_published, print_summary

TABLES = published_tables()
ROWS = [row for table in TABLES.values() for row in table.rows]
CELLS = [(row, split) for row in ROWS for split in row.scores]

MISPRINTED = {("codec", "FLUX VAE", "Robot Arm")}
"""Rows whose PSNR is not that of their MSE, as the table's note says."""


def named(table, row, column=""):
    return next(r for r in TABLES[table].rows if (r.row, r.column) == (row, column))


def rounded_from(value, decimals):
    half = 0.5 * 10**-decimals
    return value - half, value + half


@pytest.mark.parametrize(("row", "split"), CELLS, ids=lambda x: getattr(x, "table", x))
def test_psnr_is_that_of_the_pooled_mse(row, split):
    scores = row.scores[split]
    low, high = rounded_from(scores["mse"] * 1000, 3)
    least, most = -10 * math.log10(high / 1000), -10 * math.log10(low / 1000)
    shown = rounded_from(scores["psnr"], 2)
    consistent = shown[0] <= most and shown[1] >= least
    assert consistent == ((row.table, row.row, row.column) not in MISPRINTED)


def test_misprints_are_told():
    assert "not that of its MSE" in named("codec", "FLUX VAE", "Robot Arm").note


def test_tables_agree_on_what_they_share_but_for_what_is_noted():
    found = defaultdict(set)
    for row in ROWS:
        key = tuple(row.setting.items())
        for split, scores in row.scores.items():
            found[key, split].add((scores["mse"], scores["psnr"]))
    differing = {dict(key)["env"] for (key, _), values in found.items() if len(values) > 1}
    assert differing == {"cloth_move_8d", "cloth_move", "robot_arm"}
    assert "other figures" in named("conditioning", "AdaLN", "Cloth Move").note
    assert "other figures" in named("actions", "Full").note
    assert named("scale", "DiT-S", "Cloth Move").training_steps == 50_000  # why those two differ
    assert named("main", "Cloth Move").training_steps == 100_000


def test_figures_by_hand():
    assert {key: len(table.rows) for key, table in TABLES.items()} == {
        "main": 8,
        "conditioning": 8,
        "scale": 6,
        "codec": 4,
        "data": 6,
        "actions": 4,
    }
    sand = named("main", "Push Sand").scores
    assert sand["ind_test"] == pytest.approx(
        {"mse": 0.000519, "m_mse": 0.00622, "ssim": 0.975, "psnr": 32.85}
    )
    assert sand["ood_test"]["m_mse"] == pytest.approx(0.01554)
    pushers = named("actions", "Two pushers")
    assert (pushers.scores["ood_test"]["psnr"], pushers.label) == (20.0, "tab:abl_actdim")


@pytest.mark.parametrize(
    ("recipe", "row"),
    [
        ("reacher", ("main", "Reacher", "")),
        ("robot_arm_cross_attention", ("conditioning", "Cross-Attn", "Robot Arm")),
        ("cloth_move_dit_l", ("scale", "DiT-L", "Cloth Move")),
        ("pour_water_flux", ("codec", "FLUX VAE", "Pour Water")),
        ("push_cube_quarter", ("data", "25%", "Push Cube")),
        ("push_cube_two_pushers", ("actions", "Two pushers", "")),
        ("cloth_move_8d", ("conditioning", "AdaLN", "Cloth Move")),
    ],
)
def test_shipped_recipes_find_their_row(recipe, row):
    composed = compose(recipe)
    parts = {
        part: getattr(composed, part).name for part in ("env", "model", "codec", "conditioner")
    }
    found = published_for({**parts, "fraction": composed.data["fraction"]})
    assert (found.row.table, found.row.row, found.row.column) == row
    assert found.same_parts


def test_other_components_stand_beside_their_environment():
    small = {"model": "dit_xs", "codec": "compact", "conditioner": "adaln", "fraction": 1.0}
    found = published_for({"env": "pour_water", **small})
    assert (found.row.table, found.row.row, found.same_parts) == ("main", "Pour Water", False)
    assert published_for({"env": "drift", **small}) is None


def beside(evaluated, row):
    """The summary of a run as if it were of a published environment."""
    summary = Summary.read(evaluated)
    return dataclasses.replace(summary, published=published_for(row.setting))


def test_what_compares_only_so_far_says_so(evaluated):
    same = beside(evaluated, named("main", "Reacher"))
    assert "measured on other clips: compare with --protocol acwm-phys" in about_published(same)
    assert "tab:eval_main" in about_published(same)
    windowed = dataclasses.replace(same, protocol="acwm-phys")
    assert "other clips" not in about_published(windowed)
    assert "other components" not in about_published(windowed)
    other = dataclasses.replace(same.published, same_parts=False)
    assert "other components" in about_published(dataclasses.replace(same, published=other))


def test_they_survive_the_summary_file(evaluated, tmp_path):
    summary = beside(evaluated, named("scale", "DiT-M", "Robot Arm"))
    (tmp_path / "evaluation").mkdir()
    summary.write(tmp_path / "evaluation")
    assert Summary.read(tmp_path).published == summary.published


def test_the_command_prints_both(evaluated, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")  # where all columns stand beside each other
    summary = beside(evaluated, named("main", "Push Cube"))
    print_summary(summary)
    printed = re.sub(r"\s+", " ", capsys.readouterr().out)
    ours = [each.scores.rows["model"]["psnr"].value for each in summary.splits.values()]
    _, published = printed.split("published: Push Cube ")
    numbers = [float(cell.rstrip("▼")) for cell in published.split()[:8]]
    assert numbers == [2.919, 11.43, 0.955, 25.35, 2.95, 7.47, 0.954, 25.3]
    assert "0.954▼" in published
    assert all(f" {value:.2f}" in printed for value in ours)
    assert "arXiv 2605.08567" in printed
    print_summary(beside(evaluated, named("actions", "Two pushers")))
    assert re.search(r"9\.997▼ +20\.0+▼", capsys.readouterr().out)


def test_an_environment_of_ones_own_has_none(evaluated, capsys):
    summary = Summary.read(evaluated)
    assert summary.published is None
    print_summary(summary)
    assert "published" not in capsys.readouterr().out
