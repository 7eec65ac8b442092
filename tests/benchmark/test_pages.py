"""What takes evaluated runs takes scores of predictions as well."""

import shutil

import pytest

from acwm_core.cli import main
from acwm_report.boards import boards_of
from acwm_report.comparison import compare_runs
from acwm_report.leaderboard import collect
from tests.report.test_page import Page

CARD = """\
name: Drawn squares
url: https://example.org/squares
parameters: 1200000
data: 1000 episodes
compute: 8 hours
"""


@pytest.fixture(scope="module")
def home(predictions, run, tasks, truth, tmp_path_factory):
    """A folder with the run and the scores of what its model predicted, as an entry."""
    home = tmp_path_factory.mktemp("board")
    shutil.copytree(run, home / "run")
    entry = shutil.copytree(predictions, home.with_name("entry"))
    (entry / "entry.yaml").write_text(CARD)
    words = ["score", str(entry), "--tasks", str(tasks), "--data", str(truth)]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(home / "squares")])
    assert not ended.value.code
    return home


def page_of(*words, out):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words), "--out", str(out)])
    assert not ended.value.code
    text = out.read_text()
    parsed = Page(text)
    assert all(load.startswith(("data:", "#", "https://example.org/")) for load in parsed.loads)
    return text, " ".join(" ".join(parsed.text).split())


def test_a_report_is_made_of_scores(home, tmp_path):
    _, words = page_of("report", home / "squares/slide", out=tmp_path / "report.html")
    assert "a still picture" in words
    assert "submitted predictions, 1,200,000 parameters" in words
    assert "acwm score" in words
    assert "another episode’s actions" not in words.partition("Scores")[0]


@pytest.mark.ci
def test_scores_and_a_run_are_compared_in_one_report_and_one_table(home, tmp_path):
    both = home / "run", home / "squares/slide"
    _, words = page_of("report", *both, out=tmp_path / "report.html")
    assert "Significance" in words
    found = compare_runs(both)
    assert found.warnings == []
    assert {each.winner for each in found.differences} == {None}
    assert max(abs(each.difference) for each in found.differences) < 1e-6
    assert set(found.hashes["slide"]) >= {"predictions", "tasks"}


def test_a_leaderboard_shows_both_by_capability_with_their_cards(home, tmp_path):
    (board,) = boards_of(collect(home).entries)
    assert list(board.tables) == ["Pixels", "Response to actions"]
    for table in board.tables.values():
        assert {row.title for row in table.rows} == {"run", "Drawn squares"}
        by_row = [[cell.value for cell in row.cells] for row in table.rows]
        assert by_row[0] == pytest.approx(by_row[1], abs=1e-6)
    text, words = page_of("leaderboard", home, out=tmp_path / "board.html")
    for fact in ("1.2 M parameters", "1000 episodes", "8 hours", "squares/slide"):
        assert fact in words
    assert '<a href="https://example.org/squares"' in text
    assert text.count("<video") == 2


def test_an_entry_that_links_to_code_is_left_out(home, tmp_path):
    copy = shutil.copytree(home, tmp_path / "copy")
    summary = copy / "squares/slide/evaluation/summary.json"
    summary.write_text(summary.read_text().replace("https://example.org/squares", "javascript:x"))
    assert "does not begin with https://" in next(iter(collect(copy).broken.values()))
