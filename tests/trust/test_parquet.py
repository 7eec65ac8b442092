"""Parquet files that stand for more than they are: refused within bounded memory."""

import contextlib
import subprocess
import sys
import textwrap

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from acwm_core.untrusted import most_values

TEXTS = ("split", "ood_label", "kind")

MEGABYTES = 200
"""Of memory, with the libraries."""


def bomb(path, rows, **columns):
    """A small file of results whose `columns` are not small."""
    texts = {name: pa.array(["x"]).take(pa.array([0] * rows)) for name in TEXTS}
    numbers = {name: pa.array(np.zeros(rows, np.int32)) for name in ("episode", "start", "frames")}
    table = pa.table({**columns, **texts, **numbers, **columns})
    pq.write_table(
        table,
        path,
        compression="zstd",
        use_dictionary=[*columns] if rows > 1 else False,
        write_statistics=False,
        dictionary_pagesize_limit=2**20,
    )
    assert path.stat().st_size < 200_000
    return path


def lying(path):
    """The same with a footer that says that nothing is packed: only the pages tell."""
    data = bytearray(path.read_bytes())
    facts = pq.ParquetFile(path).metadata.row_group(0)
    column = facts.column(0)

    def varint(number):
        number, found = number << 1, b""
        while number > 127:
            number, found = number >> 7, found + bytes([number & 127 | 128])
        return found + bytes([number])

    for size in (column.total_uncompressed_size, facts.total_byte_size):
        old = varint(size)
        place = data.rindex(old)
        data[place : place + len(old)] = bytes(
            [data[place] & 0x80 | 0x80, *[128] * (len(old) - 2), 0]
        )
    path.write_bytes(data)
    assert pq.ParquetFile(path).metadata.row_group(0).column(0).total_uncompressed_size == 0
    return path


def read_in_little_memory(path):
    """What `load_scores` says of a file in a process of its own, and its peak of memory in MB."""
    program = f"""
        from pathlib import Path
        from acwm_core.errors import AcwmError
        from acwm_core.evaluation.storage import load_scores
        try:
            print(len(load_scores(Path({str(path)!r}))))
        except AcwmError as error:
            print(error)
        status = Path("/proc/self/status").read_text()
        print(int(status.split("VmHWM:")[1].split()[0]) // 1024)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True
    )
    *said, peak = done.stdout.splitlines()
    return "\n".join(said), int(peak)


def one_text(path):
    return bomb(path, 1, split=["x" * 2**26])


def text_of_a_metric(path):
    """Each row is the number of a text, until it is read."""
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * 4000), pa.array(["x" * 2**18]))
    return bomb(path, 4000, psnr=texts)


CASES = {
    "long text": one_text,
    "lying footer": lambda path: lying(one_text(path)),
    "text for a number": text_of_a_metric,
}


@pytest.mark.parametrize("name", CASES)
def test_results_that_stand_for_gigabytes(tmp_path, name):
    said, peak = read_in_little_memory(CASES[name](tmp_path / "episodes.parquet"))
    assert "is damaged" in said
    assert "\n" not in said
    assert peak < MEGABYTES


def test_a_page_of_two_gigabytes(tmp_path):
    """The header of a page says so, and nothing else does."""
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"a": np.arange(10.0)}), path, use_dictionary=False)
    data = bytearray(path.read_bytes())
    place = pq.ParquetFile(path).metadata.row_group(0).column(0).data_page_offset
    assert data[place] == 0x15  # the kind of the page, then its size unpacked
    assert data[place + 2] == 0x15
    old = 1 + (data[place + 3] > 127)
    data[place + 3 : place + 3 + old] = b"\xfe\xff\xff\xff\x0f"
    path.write_bytes(data)
    with pytest.raises(ValueError, match="it claims 10 values"):
        most_values(path)


def test_the_process_survives_any_footer(tmp_path):
    """Arrow ends it by SIGABRT where the footer claims columns that are not there."""
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"a": np.arange(10.0), "b": np.arange(10.0)}), path)
    whole = path.read_bytes()
    for place in range(len(whole) - 900, len(whole), 7):
        path.write_bytes(whole[:place] + b"\xff" + whole[place + 1 :])
        with contextlib.suppress(ValueError):
            most_values(path)
