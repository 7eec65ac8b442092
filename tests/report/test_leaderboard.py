"""`acwm leaderboard`: like beside like, and nothing lost in silence."""

import json
import shutil

import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_report.boards import boards_of
from acwm_report.leaderboard import collect, write_leaderboard
from tests.report import synthetic
from tests.report.test_page import Page

SCORES = np.linspace(20, 26, 8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs of two environments, two protocols and two sets of test data, and broken files."""
    root = tmp_path_factory.mktemp("board")

    def both(shift):
        outside = synthetic.clips(SCORES + shift - 2, "ood_test")
        return [*synthetic.clips(SCORES + shift), *outside]

    synthetic.run(root / "a" / "first", both(0), weights="1" * 64)
    synthetic.run(root / "a" / "deeper" / "second", both(1), weights="2" * 64)
    synthetic.run(root / "other_world", both(2), environment="reacher")
    synthetic.run(root / "windows", both(3), protocol="acwm-phys")
    synthetic.run(root / "other_data", both(4), checksums={"ind_test": "c" * 64})
    fewer = synthetic.clips(SCORES[:5])
    synthetic.run(root / "fewer", fewer)
    sent = root / "sent"  # a result file without its run
    sent.mkdir()
    shutil.copy(root / "a" / "first" / "evaluation" / "summary.json", sent / "summary.json")
    old = synthetic.run(root / "old", both(5)) / "evaluation" / "summary.json"
    values = json.loads(old.read_text())
    del values["provenance"]["weights_sha256"]
    old.write_text(json.dumps(values))
    for name, text in {"cut": '{"run": ', "list": "[]", "bytes": "\x00\x01"}.items():
        (root / name).mkdir()
        (root / name / "summary.json").write_text(text)
    return root


def test_only_runs_that_predicted_the_same_clips_share_a_table(folder):
    boards = boards_of(collect(folder).entries)
    names = [sorted(row.title for row in board.table.rows) for board in boards]
    assert sorted(names) == [
        ["a/deeper/second", "a/first"],
        ["fewer"],
        ["other_data"],
        ["other_world"],
        ["windows"],
    ]
    shared = next(board for board in boards if len(board.table.rows) == 2)
    assert [row.title for row in shared.table.rows] == ["a/deeper/second", "a/first"]  # best first
    assert shared.data == "ind_test aaaaaaaa, ood_test bbbbbbbb"


def test_what_else_was_given_or_measured_has_a_board_of_its_own(tmp_path):
    rows = synthetic.clips(SCORES)
    synthetic.run(tmp_path / "one", rows, weights="1" * 64)
    synthetic.run(tmp_path / "five", rows, weights="2" * 64, given=5)
    synthetic.run(tmp_path / "again", rows, weights="3" * 64, checksums={"ind_test": "c" * 64})
    short = [synthetic.clip(r.kind, r.episode, r.values["psnr"], frames=4) for r in rows]
    synthetic.run(tmp_path / "short", short, weights="4" * 64)
    boards = boards_of(collect(tmp_path).entries)
    names = {frozenset(row.title for row in board.table.rows): board for board in boards}
    assert names.keys() == {
        frozenset({"one", "again"}),  # simulated by another kind of processor
        frozenset({"five"}),
        frozenset({"short"}),
    }
    assert names[frozenset({"five"})].protocol == "full, 5 given frames"
    assert names[frozenset({"one", "again"})].data == "ind_test cccccccc ≈ aaaaaaaa"


def test_an_unfinished_model_is_marked(tmp_path):
    synthetic.run(tmp_path / "early", synthetic.clips(SCORES), planned=3000)
    ((row,),) = [board.table.rows for board in boards_of(collect(tmp_path).entries)]
    assert "trained for 200 of 3,000 steps" in row.note


@pytest.mark.parametrize("facts", [{"parameters": -5}, {"parameters": 10**20}])
def test_numbers_that_cannot_be_are_not_shown(facts, tmp_path):
    path = synthetic.run(tmp_path / "run", synthetic.clips(SCORES)) / "evaluation/summary.json"
    values = json.loads(path.read_text())
    values["provenance"] |= facts
    path.write_text(json.dumps(values))
    assert "not a possible number" in collect(tmp_path).broken["run/evaluation/summary.json"]


def test_scores_are_those_of_the_files(folder):
    boards = boards_of(collect(folder).entries)
    table = next(board for board in boards if len(board.table.rows) == 2).table
    keys = [column.key for column in table.columns]
    row = table.rows[0]
    summary = json.loads((folder / "a/deeper/second/evaluation/summary.json").read_text())
    for split in ("ind_test", "ood_test"):
        for metric in ("mse", "psnr"):
            cell = row.cells[keys.index(f"{split}_{metric}")]
            expected = summary["splits"][split]["scores"]["rows"]["model"][metric]
            assert (cell.value, cell.low, cell.high) == tuple(expected.values())
            near = summary["splits"]["ind_test"]["scores"]["rows"]["model"][metric]
            drop = (expected["value"] - near["value"]) * (-1 if metric == "psnr" else 1)
            allowed = np.hypot(*((each["high"] - each["low"]) / 2 for each in (expected, near)))
            assert cell.worse == (split == "ood_test" and drop > allowed)


def test_broken_files_are_named_and_copies_counted(folder):
    found = collect(folder)
    assert found.copies == 1
    assert found.broken.keys() == {
        "old/evaluation/summary.json",
        "cut/summary.json",
        "list/summary.json",
        "bytes/summary.json",
    }
    assert "weights_sha256" in found.broken["old/evaluation/summary.json"]
    assert "not a summary of this version" in found.broken["cut/summary.json"]


def test_the_page_is_well_formed_and_says_what_it_left_out(folder, tmp_path, capsys):
    out = tmp_path / "deep" / "board.html"
    with pytest.raises(SystemExit) as ended:
        main(["leaderboard", str(folder), "--out", str(out)])
    assert ended.value.code == 0
    said = capsys.readouterr()
    assert said.out.strip() == str(out)
    assert "left out cut/summary.json" in said.err
    text = out.read_text(encoding="utf-8")
    parsed = Page(text)
    assert all(load.startswith(("data:", "#")) for load in parsed.loads)
    assert "https://" not in text
    words = " ".join(" ".join(parsed.text).split())
    for name in ("a/deeper/second", "other_world", "old/evaluation/summary.json", "6 entries"):
        assert name in words
    assert "1 further file is a copy" in words


def test_nothing_to_show_is_an_error(tmp_path):
    with pytest.raises(DataError, match="there is no folder"):
        write_leaderboard(tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no results: run `acwm evaluate`"):
        write_leaderboard(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(DataError, match=r"no results that can be read \(summary.json:"):
        write_leaderboard(tmp_path)
