"""Tables and figures as files: they say what the summary says."""

import csv
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from acwm_core.cli import main
from acwm_report.export import to_csv, to_latex, to_markdown
from acwm_report.page import export_report
from acwm_report.table import Cell, Column, Row, Table
from tests.report import synthetic

DOCUMENT = r"""\documentclass{article}
\usepackage{booktabs,multirow,xcolor}
\begin{document}
%s
\end{document}
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = tmp_path_factory.mktemp("export")
    scores = np.linspace(20, 26, 9)
    rows = [*synthetic.clips(scores), *synthetic.clips(scores - 2.5, "ood_test")]
    run = synthetic.run(root / "run_1", rows)
    out = root / "out"
    with pytest.raises(SystemExit) as ended:
        main(["report", str(run), "--out", str(root / "page.html"), "--export", str(out)])
    assert ended.value.code == 0
    return run, out


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def summary_of(run):
    return json.loads((run / "evaluation/summary.json").read_text())


@pytest.mark.ci
def test_csv_holds_the_numbers_of_the_summary_at_full_precision(exported):
    run, out = exported
    rows = summary_of(run)["splits"]["ood_test"]["scores"]["rows"]
    titles = {"model": "Model, true actions", "copy": "First frame, repeated"}
    table = {row["Prediction"]: row for row in read(out / "tables/scores-ood_test.csv")}
    for kind, title in titles.items():
        for metric in ("mse", "psnr"):
            for key, ending in (("value", ""), ("low", "_low"), ("high", "_high")):
                assert float(table[title][metric + ending]) == rows[kind][metric][key]
    (main_row,) = read(out / "tables/main.csv")
    assert float(main_row["ood_test_mse"]) == rows["model"]["mse"]["value"]
    episodes = read(out / "tables/episodes.csv")
    assert len(episodes) == 18
    worst = min(float(row["psnr"]) for row in episodes if row["split"] == "In distribution")
    assert worst == pytest.approx(20)


@pytest.mark.ci
def test_markdown_parses_back_to_the_written_numbers(exported):
    run, out = exported
    text = (out / "tables/scores-ind_test.md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    assert len({len(line) for line in cells}) == 1
    model = next(line for line in cells if "Model, true actions" in line[0])
    rows = summary_of(run)["splits"]["ind_test"]["scores"]["rows"]["model"]
    assert float(model[1].split()[0]) == pytest.approx(1000 * rows["mse"]["value"], abs=5e-3)
    assert float(model[2].split()[0]) == pytest.approx(rows["psnr"]["value"], abs=5e-3)
    low, high = re.search(r"\[(.*) to (.*)\]", model[2]).groups()
    assert (float(low), float(high)) == pytest.approx(
        (rows["psnr"]["low"], rows["psnr"]["high"]), abs=5e-3
    )


@pytest.mark.ci
def test_latex_is_balanced_and_has_as_many_columns_as_it_says(exported):
    _, out = exported
    files = list((out / "tables").glob("*.tex"))
    assert {path.stem for path in files} >= {"main", "scores-ind_test", "shifts", "episodes"}
    for path in files:
        check_latex(path.read_text(encoding="utf-8"))


def check_latex(text):
    assert text.isascii()
    assert text.count("{") == text.count("}")
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 1
    columns = len(re.findall("[lc]", re.search(r"\\begin\{tabular\}\{([^}]*)\}", text)[1]))
    for line in text.splitlines():
        if line.endswith(r"\\"):
            spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
            cells = len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans)
            assert cells == columns, line


@pytest.mark.skipif(not shutil.which("pdflatex"), reason="there is no pdflatex")
@pytest.mark.ci
def test_latex_compiles(exported, tmp_path):
    _, out = exported
    tables = [path.read_text(encoding="utf-8") for path in (out / "tables").glob("*.tex")]
    (tmp_path / "all.tex").write_text(DOCUMENT % "\n\n".join(tables))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-2000:]


@pytest.mark.ci
def test_every_figure_is_there_as_png_and_pdf(exported):
    _, out = exported
    pictures = {path.stem for path in (out / "figures").glob("*.png")}
    assert pictures == {path.stem for path in (out / "figures").glob("*.pdf")}
    assert {"horizon-ind_test", "horizon-ood_test", "pairs-ind_test"} <= pictures
    for path in (out / "figures").glob("*.png"):
        pixels = np.asarray(Image.open(path).convert("RGB"))
        assert pixels[0, 0].tolist() == [255, 255, 255]
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 10
    for path in (out / "figures").glob("*.pdf"):
        assert path.read_bytes().startswith(b"%PDF")


def test_hard_words_survive_every_format(tmp_path):
    columns = [Column("50 % & more", "×10⁻³", "↓", group="A_B", key="score"), Column("plain")]
    rows = [
        Row("a|b {x} #1", [Cell("−1.50", "", -0.0015, -0.002, -0.001), Cell("–")]),
        Row('x, "y" ~^\\', [Cell("2.00", worse=True), Cell("Δ ≈ 3°")], group="G"),
    ]
    table = Table("T_1", columns, rows, "row")
    check_latex(to_latex(table))
    parsed = list(csv.reader(to_csv(table).splitlines()))
    assert parsed[0] == ["group", "row", "note", "score", "score_low", "score_high", "plain"]
    assert parsed[1][1:] == ["a|b {x} #1", "", "-0.0015", "-0.002", "-0.001", ""]
    assert parsed[2][1] == 'x, "y" ~^\\'
    lines = to_markdown(table).splitlines()
    assert len(re.findall(r"(?<!\\)\|", lines[-1])) == len(re.findall(r"(?<!\\)\|", lines[-2])) == 4
    if shutil.which("pdflatex"):
        (tmp_path / "t.tex").write_text(DOCUMENT % to_latex(table))
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"]
        assert subprocess.run(command, cwd=tmp_path, capture_output=True).returncode == 0


@pytest.mark.ci
def test_several_runs_lie_in_folders_of_their_own(tmp_path):
    scores = np.linspace(20, 26, 6)
    runs = [synthetic.run(tmp_path / n, synthetic.clips(scores + i)) for i, n in enumerate("ab")]
    written = export_report(runs, tmp_path / "out")
    assert all(path.is_file() for path in written)
    assert len(set(written)) == len(written)
    names = {str(path.relative_to(tmp_path / "out")) for path in written}
    assert {"tables/main.tex", "tables/comparison.csv", "a/tables/scores-ind_test.md"} <= names
    assert "b/figures/horizon-ind_test.pdf" in names
