"""Results of strangers on a page, in files and on a terminal: nothing of theirs is run or read."""

import base64
import csv
import hashlib
import io
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import AcwmError, AcwmWarning
from acwm_core.evaluation.results import Summary, VideoRecord
from acwm_report.export import file_name, to_csv, to_markdown
from acwm_report.figures import Chart, Curve
from acwm_report.leaderboard import write_leaderboard
from acwm_report.page import export_report, write_report
from acwm_report.table import Cell, Column, Row, Table
from tests.report.synthetic import clips, run

SECRET = "root:x:0:0"
EVIL = "<script>alert(1)</script>"


@pytest.fixture
def folder(tmp_path):
    return run(tmp_path / "run", [*clips([20.0, 21.0, 22.0]), *clips([18.0, 19.0], "ood_test")])


def edit(folder, change):
    """Change `summary.json` as a stranger would, by hand."""
    file = folder / "evaluation/summary.json"
    values = json.loads(file.read_text())
    change(values)
    file.write_text(json.dumps(values))


def video(file):
    record = VideoRecord(file, "ind_test", 0, None, "best", "model", {"psnr": 20.0}, [[0.0]] * 5)
    return {**vars(record)}


def renamed(values, name):
    splits = values["splits"]
    values["splits"] = {name: splits.pop("ind_test"), **splits}


def wrong(folder):
    """What is said of results of which no page is made."""
    page = folder.parent / "page.html"
    with pytest.raises(AcwmError) as raised:
        write_report([folder], page)
    assert "\n" not in str(raised.value)
    assert not page.exists()
    return str(raised.value)


@pytest.mark.parametrize(
    "file",
    ["/etc/passwd", "../../secret.mp4", "../secret.mp4", "a/b.mp4", ".mp4", "x.html", "é.mp4"],
)
def test_a_video_is_a_file_of_the_run(folder, file):
    edit(folder, lambda values: values["videos"].append(video(file)))
    assert "videos.0.file" in wrong(folder)


def test_a_video_that_is_a_link(folder, tmp_path):
    (tmp_path / "secret").write_text(SECRET)
    (folder / "evaluation" / "videos").mkdir()
    (folder / "evaluation" / "videos" / "a.mp4").symlink_to(tmp_path / "secret")
    edit(folder, lambda values: values["videos"].append(video("a.mp4")))
    result = CliRunner().invoke(main, ["report", str(folder), "--export", str(folder / "out")])
    assert result.exit_code == 2, result.output
    assert "leads out of" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(folder.glob("*.html"))
    assert not (folder / "out").exists()


NAMES = (EVIL, "../../out", "/tmp/x", 'x" onload="alert(1)', "a\nb", "", "\\1", "\u202e")


@pytest.mark.parametrize("name", NAMES[:2])
def test_names_become_no_markup_and_no_path(folder, name):
    file = folder / "evaluation/summary.json"
    before = file.read_bytes()

    def metric(values):
        values["metrics"][name] = values["metrics"]["psnr"]
        rows = values["splits"]["ind_test"]["scores"]["rows"]
        rows["model"][name] = rows["model"]["psnr"]

    for change in (
        lambda values: renamed(values, name),
        metric,
        lambda values: values["videos"].append({**video("a.mp4"), "split": name}),
    ):
        file.write_bytes(before)
        edit(folder, change)
        wrong(folder)


def test_rows_that_acwm_does_not_know_are_not_shown(folder, tmp_path):
    def change(values):
        rows = values["splits"]["ind_test"]["scores"]["rows"]
        rows.update({name: rows["copy"] for name in NAMES})

    edit(folder, change)
    page = write_report([folder], tmp_path / "page.html")
    own_script_only(page)
    assert EVIL not in page.read_text()


class Scripts(HTMLParser):
    """What of a page would run, or load something."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.found, self.policy = [], [], ""
        self._in_script = False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self._in_script = tag == "script"
        given = dict(attributes)
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"]
        for name, value in attributes:
            if name.startswith("on") or (name in ("src", "href") and value[:1] not in ("#", "d")):
                self.found.append((tag, name, value))

    def handle_data(self, data):
        if self._in_script:
            self.scripts.append(data)

    def handle_endtag(self, tag):
        self._in_script = False


def own_script_only(page):
    """The policy of the page lets its one script run, and nothing else."""
    parsed = Scripts(page.read_text())
    (script,) = parsed.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in parsed.policy
    assert parsed.policy.startswith("default-src 'none';")
    assert parsed.found == []
    return parsed


def test_free_text_is_escaped_and_the_page_runs_its_own_script_only(folder, tmp_path):
    def change(values):
        values["run"] = values["environment"]["summary"] = EVIL
        values["environment"]["action"]["names"] = [EVIL]
        values["metrics"]["psnr"]["title"] = values["metrics"]["psnr"]["unit"] = EVIL
        values["provenance"]["recipe"] = values["provenance"]["device"] = f"</pre>{EVIL}"
        values["left_out"] = {EVIL: f'" onload="alert(1)" {EVIL}'}
        values["protocol"] = values["parts"]["model"] = f"'\"><img src=x onerror=alert(1)>{EVIL}"
        label = values["splits"]["ood_test"]["labels"]
        label[EVIL] = label.pop("mass")

    edit(folder, change)
    page = write_report([folder], tmp_path / "page.html")
    own_script_only(page)
    assert EVIL not in page.read_text()
    board, _ = write_leaderboard(tmp_path, tmp_path / "board.html")
    own_script_only(board)
    assert EVIL not in board.read_text()


@pytest.mark.slow  # names of files are tested below
def test_exports_stay_in_their_folder(folder, tmp_path):
    edit(folder, lambda values: values["metrics"]["psnr"].update(title="../../../x"))
    before = {path for path in tmp_path.rglob("*") if path.is_file()}
    written = export_report([folder / ".." / "run"], tmp_path / "out" / "deep")
    assert written
    assert {path for path in tmp_path.rglob("*") if path.is_file()} - before == {
        path for path in (tmp_path / "out" / "deep").rglob("*") if path.is_file()
    }


@pytest.mark.parametrize("name", ["..", "../x", "/etc/passwd", ".hidden", "", "a\0b", "x/../../y"])
def test_names_of_files(name):
    made = file_name(name)
    assert made == made.strip("/")
    assert "/" not in made
    assert made not in ("", ".", "..")
    assert file_name("push_cube+small") == "push_cube+small"


@pytest.mark.parametrize("cell", ['=HYPERLINK("x")', "+1+1", "-1+1", "@SUM(A1)", "\t=1", "\r=1"])
def test_no_cell_is_a_formula(cell):
    table = Table(cell, [Column(cell)], [Row(cell, [Cell(cell)])], corner=cell)
    rows = list(csv.reader(io.StringIO(to_csv(table))))
    assert all(not each or each[0] not in "=+-@\t\r" for row in rows for each in row)
    assert "-1.5" in to_csv(Table("", [Column("a")], [Row("b", [Cell("x", value=-1.5)])]))


def test_markdown_holds_no_markup_of_others():
    evil = f"{EVIL}|\n\n# head"
    table = Table(evil, [Column(evil)], [Row(evil, [Cell(evil)])], caption=evil)
    text = to_markdown(table)
    assert "<script" not in text
    assert "\n# head" not in text


def test_names_are_no_formulas_in_charts(tmp_path):
    curve = Curve(r"$\frac{$", "model", [0.0, 1.0], [1.0, 2.0])
    chart = Chart(r"$\undefined$ $x^", "a\" onload='x'", [curve], r"$\bad{", "cost in $ and $")
    assert r"$\bad{" in chart.svg
    assert "onload=" not in chart.svg
    chart.save(tmp_path / "chart.png")
    chart.save(tmp_path / "chart.pdf")


DAMAGES = {
    "no JSON": lambda file: file.write_text("{"),
    "a list": lambda file: file.write_text("[]"),
    "not splits": lambda file: rewrite(file, lambda v: v.update(splits={})),
    "no provenance": lambda file: rewrite(file, lambda v: v.update(provenance={})),
    "no model": lambda file: rewrite(
        file, lambda v: v["splits"]["ind_test"]["scores"].update(rows={})
    ),
    "no pairs": lambda file: rewrite(
        file, lambda v: v["splits"]["ind_test"]["scores"].update(paired={})
    ),
    "no parts": lambda file: rewrite(file, lambda v: v.update(parts={})),
    "fps of 0": lambda file: rewrite(file, lambda v: v["environment"].update(fps=0)),
    "another headline": lambda file: rewrite(file, lambda v: v.update(headline="mse_")),
    "no rows": lambda file: (file.parent / "episodes.parquet").write_bytes(b"PAR1"),
    "gone": lambda file: file.unlink(),
}


def rewrite(file, change):
    edit(file.parents[1], change)


def test_bad_runs_kill_no_page(tmp_path):
    good = run(tmp_path / "good", clips([20.0, 21.0, 22.5]))
    bad = [Path(shutil.copytree(good, tmp_path / damage)) for damage in DAMAGES]
    for folder in bad:
        DAMAGES[folder.name](folder / "evaluation/summary.json")
        wrong(folder)
    board, found = write_leaderboard(tmp_path, tmp_path / "board.html")
    assert "good" in found.entries
    assert board.exists()
    with pytest.warns(AcwmWarning) as warned:
        page = write_report([good, *bad], tmp_path / "page.html").read_text()
    assert "Not shown" in page
    for folder in bad:
        assert str(folder) in page
        assert any(str(folder) in str(each.message) for each in warned)


def test_results_of_old_are_read():
    found = Summary.load(Path("tests/reference/first_release/run/evaluation/summary.json"))
    assert any(split.counterfactual.residual for split in found.splits.values())
