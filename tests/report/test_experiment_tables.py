"""Tables of an experiment: means over seeds, published figures below, paired differences."""

import numpy as np
import pytest

from acwm_core.errors import DataError
from acwm_experiment.table import Experiment, ExperimentCell
from acwm_report.experiment import experiment_tables
from acwm_report.export import to_csv, to_latex
from acwm_report.page import export_report, write_report
from tests.report import synthetic

EPISODES = 12
LEVELS = {("AdaLN", "Push Cube"): (20.0, 21.0, 22.0), ("Cross-Attn", "Push Cube"): (24.0, 25.0)}


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """AdaLN with three seeds; Cross-Attn with two of three, 3.5 dB better; the rest to be run."""
    folder = tmp_path_factory.mktemp("experiment")
    noise = np.random.default_rng(0).normal(0, 1, EPISODES)
    cells = []
    for row in ("AdaLN", "Cross-Attn"):
        for column in ("Push Cube", "Robot Arm"):
            runs = [folder / "runs" / f"{row}-{column}-{seed}" for seed in range(3)]
            for level, run in zip(LEVELS.get((row, column), ()), runs, strict=False):
                inside = synthetic.clips(level + noise)
                synthetic.run(run, inside + synthetic.clips(level - 2 + noise, "ood_test"))
            cells.append(ExperimentCell(row, column, "push_cube", (), tuple(runs)))
    groups = {"Modulation": ("AdaLN",), "Attention": ("Cross-Attn",)}
    columns = ("Push Cube", "Robot Arm")
    made = Experiment(
        "mine", "Conditioning", "One against the other.", "conditioning", ("AdaLN", "Cross-Attn"),
        columns, groups, (0, 1, 2), tuple(cells),
    )  # fmt: skip
    made.write(folder)
    return Experiment.read(folder)


def row(table, title):
    keys = [column.key for column in table.columns]
    (found,) = [each for each in table.rows if each.title == title]
    return dict(zip(keys, found.cells, strict=True)), found


def test_scores_are_means_over_seeds_beside_the_papers(experiment):
    table, differences = experiment_tables(experiment)
    assert [each.title for each in table.rows] == ["AdaLN", "published", "Cross-Attn", "published"]
    assert [each.group for each in table.rows[::2]] == ["Modulation", "Attention"]
    cells, adaln = row(table, "AdaLN")
    noise = np.random.default_rng(0).normal(0, 1, EPISODES)
    errors = [np.mean(10 ** (-(level + noise) / 10)) for level in LEVELS["AdaLN", "Push Cube"]]
    means = -10 * np.log10(errors)  # of the pooled error, as the paper has it
    inside = cells["Push Cube ind_test psnr"]
    assert inside.value == pytest.approx(np.mean(means))
    assert inside.interval.startswith("±1.00 · ")
    assert inside.low < inside.value - 2 < inside.value + 2 < inside.high  # three seeds, 1 dB apart
    assert [inside.worse, cells["Push Cube ood_test psnr"].worse] == [False, False]  # wide
    assert cells["Robot Arm ind_test psnr"].value is None
    assert adaln.note == "0 of 3 seeds in some cells"
    quoted = dict(zip([c.key for c in table.columns], table.rows[1].cells, strict=True))
    assert quoted["Push Cube ind_test mse"].text == "2.919"
    assert quoted["Robot Arm ood_test psnr"].text == "21.83"
    assert "arXiv 2605.08567, tab:abl_action_cond" in table.caption
    assert differences.name == "mine_differences"
    assert "Modulation,AdaLN" in to_csv(table)
    assert r"\multicolumn" in to_latex(table)


def test_differences_are_of_the_same_clips(experiment):
    _, table = experiment_tables(experiment)
    cells, _ = row(table, "Cross-Attn")
    found = cells["Push Cube ind_test psnr"]
    assert found.value == pytest.approx(3.5)
    assert found.text == "+3.50"
    spread = found.high - found.low
    assert found.low > 0  # the episodes are the same, and their chance cancels
    assert spread == pytest.approx(2 * 3.1 * np.sqrt(1 / 3 + 0.5 / 2), rel=0.2)  # Welch, 3 freedoms
    assert cells["Robot Arm ind_test psnr"].value is None


def test_other_clips_are_not_compared(experiment, tmp_path):
    cells = list(experiment.cells)
    runs = tuple(tmp_path / f"run-{seed}" for seed in range(2))
    for run in runs:
        clips = synthetic.clips(np.arange(EPISODES) + 20.0)
        synthetic.run(run, clips, checksums={"ind_test": "c" * 64})
    cells[2] = ExperimentCell("Cross-Attn", "Push Cube", "push_cube", (), runs)
    changed = Experiment(**{**vars(experiment), "cells": tuple(cells)})
    tables = experiment_tables(changed)
    assert len(tables) == 1
    assert row(tables[0], "Cross-Attn")[1].cells[0].value is not None


def test_an_experiment_without_results_has_no_table(experiment, tmp_path):
    cells = tuple(
        ExperimentCell(c.row, c.column, "", (), (tmp_path / "none",)) for c in experiment.cells
    )
    with pytest.raises(DataError, match="no run of the experiment mine is evaluated yet"):
        experiment_tables(Experiment(**{**vars(experiment), "cells": cells}))


def evaluated(experiment):
    return [run for cell in experiment.cells for run in cell.runs if run.is_dir()]


@pytest.mark.ci
def test_names_lead_to_the_first_run_of_their_row(experiment, tmp_path):
    runs = evaluated(experiment)
    page = write_report(runs, tmp_path / "page.html", experiment=experiment).read_text()
    for title, run in (("AdaLN", 1), ("Cross-Attn", 4)):
        assert f'<a href="#run{run}">{title}</a>' in page
        assert f'id="run{run}"' in page


@pytest.mark.ci
def test_the_main_table_is_shown_and_exported_once(experiment, tmp_path):
    main = Experiment(**{**vars(experiment), "name": "main", "table": "main"})
    runs = evaluated(experiment)
    pages = [write_report(runs, tmp_path / "page.html", experiment=e).read_text()
             for e in (experiment, main)]  # fmt: skip
    assert ["<h2>Main table</h2>" in page for page in pages] == [True, False]
    assert "<h2>The experiment</h2>" in pages[1]
    export_report(runs[:1], tmp_path / "out", main)
    assert "Mean over seeds" in (tmp_path / "out/tables/main.md").read_text()
