"""Tables that are wider than the terminal."""

import io
import re

from rich.console import Console

from acwm_core.cli.tables import print_table

HEADS = [f"model number{n}" for n in range(9)]
ROWS = [(f"metric_{m}", [f"{m}{n}.{'1234567'}" for n in range(9)]) for m in range(3)]


def printed(width):
    file = io.StringIO()
    print_table(Console(file=file, width=width), "scores", HEADS, ROWS)
    return file.getvalue()


def test_no_number_is_cut_off_whatever_the_width():
    for width in (200, 80, 40, 25):
        text = printed(width)
        assert max(map(len, text.splitlines())) <= width
        cells = re.findall(r"\d\d\.1234567", text)
        assert sorted(cells) == sorted(cell for _, row in ROWS for cell in row)
        assert text.count("scores") == 1
        assert "…" not in text
    assert printed(200).count("metric_0") == 1
    assert printed(80).count("metric_0") == 2
