"""Folders as people have them: names in other case, tables with comments or in UTF-16."""

import codecs
import unicodedata

import numpy as np
import pytest

from acwm_core.errors import DataError
from acwm_formats.reading import ImportOptions
from acwm_formats.recordings import import_dataset
from acwm_formats.tables import read_table
from acwm_formats.videos import Videos
from tests.formats.corpus import files
from tests.formats.corpus.cases import Case, three

NAMES = ("TAKE1", "Grüße 2", "straße 3")
PLAIN = Case("plain", three(), names=NAMES)


def decomposed(name):
    return unicodedata.normalize("NFD", name)


def rows_of(folder, **options):
    recordings = Videos().read(folder, **options).splits
    return {recordings[i].name: recordings[i].actions.values for i in range(len(recordings))}


@pytest.mark.parametrize(
    "rename",
    [
        lambda path: path.with_name(path.name.upper()),
        lambda path: path.with_suffix(path.suffix.upper()),
        lambda path: path.with_name(path.name.lower()),
        lambda path: path.with_name(decomposed(path.name)),
        lambda path: path.with_name(decomposed(path.stem).title() + path.suffix),
    ],
)
@pytest.mark.parametrize("ending", ["csv", "mp4"])
def test_a_table_beside_a_video_of_almost_its_name(tmp_path, rename, ending):
    files.videos(tmp_path, PLAIN)
    right = [*rows_of(tmp_path).values()]
    for path in list(tmp_path.glob(f"*.{ending}")):
        path.rename(rename(path))
    for found, rows in zip(rows_of(tmp_path).values(), right, strict=True):
        np.testing.assert_array_equal(found, rows)


def test_names_that_differ_by_case_alone(tmp_path):
    files.videos(tmp_path, Case("plain", three(), names=("take", "Take", "TAKE")))
    names = {path.stem: len(path.read_text().splitlines()) - 1 for path in tmp_path.glob("*.csv")}
    assert {name: len(rows) for name, rows in rows_of(tmp_path).items()} == names
    (tmp_path / "take.csv").unlink()
    with pytest.raises(DataError, match="could both be the table of take: rename one"):
        Videos().read(tmp_path)


def test_one_table_that_names_videos_otherwise(tmp_path):
    files.videos(tmp_path, Case("plain", three(), names=NAMES, table="shared"))
    right = rows_of(tmp_path)
    table = tmp_path / "all.csv"
    for spelt in (str.upper, str.lower, decomposed):
        table.write_text(spelt(table.read_text()))
        found = rows_of(tmp_path, actions="ALL.csv" if spelt is str.upper else None)
        for name, rows in right.items():
            np.testing.assert_array_equal(found[name], rows)


def test_columns_with_composed_letters(tmp_path):
    (tmp_path / "a.csv").write_text(decomposed("höhe,tiefe\n1,2\n"))
    assert [*read_table(tmp_path / "a.csv")] == ["höhe", "tiefe"]


PLAIN_TEXT = "time,x,y\n0,1,2\n0.1,3,4\n"
TEXTS = {
    "plain": PLAIN_TEXT,
    "UTF-8 with a mark": codecs.BOM_UTF8 + PLAIN_TEXT.encode(),
    "UTF-16": PLAIN_TEXT.encode("utf-16"),
    "UTF-16 without a mark": PLAIN_TEXT.encode("utf-16-le"),
    "UTF-16, large end first": PLAIN_TEXT.encode("utf-16-be"),
    "UTF-32": PLAIN_TEXT.encode("utf-32"),
    "UTF-16 of Excel": PLAIN_TEXT.replace(",", "\t").replace("\n", "\r\n").encode("utf-16"),
    "comments before": f"# recorded by hand, in a hurry\n#\n\n{PLAIN_TEXT}",
    "comments between": PLAIN_TEXT.replace("0.1", "# a pause\n0.1"),
    "a header of numpy": "# time,x,y\n0,1,2\n0.1,3,4\n",
    "comments and a header of numpy": "# by hand\n#time,x,y\n0,1,2\n0.1,3,4\n# the end\n",
    "comments with as many fields": f"{PLAIN_TEXT}# stopped, by hand, at 3\n",
    "comments after a space": f"  # by hand\n{PLAIN_TEXT}\t# the end\n",
    "a comment like a header": f"# one, two, three\n{PLAIN_TEXT}",
    "a separator for Excel": f"sep=;\n{PLAIN_TEXT.replace(',', ';')}",
    "decimal commas": PLAIN_TEXT.replace(",", ";").replace(".", ","),
    "lines of old Macs": PLAIN_TEXT.replace("\n", "\r"),
    "semicolons after a comment": "# a, b, c, d\n" + PLAIN_TEXT.replace(",", ";"),
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_tables_as_programs_write_them(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    found = {name: column.tolist() for name, column in read_table(path).items()}
    assert found == {"time": [0, 0.1], "x": [1, 3], "y": [2, 4]}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (f"Recorder 2\n{PLAIN_TEXT}".encode(), "first line has 1 fields, and another one 3: remo"),
        (f"% by hand\n{PLAIN_TEXT}".encode(), "first line has 1 fields, and another one 3: remo"),
        (PLAIN_TEXT.replace("x", "höhe").encode("latin-1"), "is not in UTF-8: save it in UTF-8"),
    ],
)
def test_tables_that_need_an_edit_say_which(tmp_path, text, why):
    (tmp_path / "a.csv").write_bytes(text)
    with pytest.raises(DataError, match=why):
        read_table(tmp_path / "a.csv")


@pytest.mark.parametrize("text", ["0,1,push\n1,2,push\n2,0,pull\n", "push;3\npull;4\n"])
def test_a_first_row_in_place_of_names_is_refused(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match="its first line is a row"):
        read_table(tmp_path / "a.csv")


@pytest.mark.parametrize("text", ["frame,0,1\n0,2,5\n1,3,6\n", "task,x,0\npush,2,5\n"])
def test_numbers_may_be_names(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    assert [*read_table(tmp_path / "a.csv")] == text.splitlines()[0].split(",")


@pytest.mark.parametrize("name", ["trial", "take_id", "Segment Index", "recording.number"])
def test_a_column_that_numbers_several_recordings(tmp_path, name):
    files.videos(tmp_path, PLAIN)
    for path in tmp_path.glob("*.csv"):
        first, *rows = path.read_text().splitlines()
        numbered = [f"{row},{place // 4}" for place, row in enumerate(rows)]
        path.write_text("\n".join([f"{first},{name}", *numbered]))
    with pytest.raises(DataError, match=r"numbers [23] episodes, but .* is one"):
        rows_of(tmp_path)


@pytest.mark.parametrize("name", ["../evil", "/evil", "a\nb", ".."])
def test_a_name_that_leads_elsewhere_is_refused_at_once(tmp_path, name):
    files.videos(tmp_path, PLAIN)
    with pytest.raises(DataError, match="cannot be the name of an environment"):
        import_dataset(Videos().read(tmp_path), tmp_path / "out", ImportOptions(environment=name))
    assert not (tmp_path / "out").exists()


def test_what_numpy_writes(tmp_path):
    rows = np.array([[0, 1, 2], [0.1, 3, 4]])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="made\ntime,x,y", footer="end")
    found = read_table(tmp_path / "a.csv")
    assert [*found] == ["time", "x", "y"]
    np.testing.assert_array_equal(np.stack([*found.values()], 1), rows)


def test_text_that_begins_with_a_hash_is_kept(tmp_path):
    (tmp_path / "a.csv").write_text("colour,x\n#ff0000,1\n#00ff00,2\n")
    assert read_table(tmp_path / "a.csv")["colour"].tolist() == ["#ff0000", "#00ff00"]


def test_lines_of_json_in_utf_16(tmp_path):
    (tmp_path / "a.jsonl").write_bytes('{"x": 1}\n{"x": 2}\n'.encode("utf-16"))
    assert read_table(tmp_path / "a.jsonl")["x"].tolist() == [1, 2]
