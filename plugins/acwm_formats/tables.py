"""Tables of numbers beside a video: CSV, TSV, NPY, NPZ, JSON, JSONL and Parquet, by column."""

from __future__ import annotations

import codecs
import importlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.arrays import check_unpacked, load_npy, load_npz
from acwm_core.errors import DataError, suggest
from acwm_core.files import check_fetched, parse_json
from acwm_formats.episode_bounds import NUMBERS, bounds_of, divides, plain
from acwm_formats.names import composed

arrow: Any = importlib.import_module("pyarrow")  # it has no type annotations

Table = Mapping[str, NDArray[Any]]
"""Columns ``[N]`` by name, all of the same length; a vector is a column ``NAME_i`` per entry."""

SECONDS = {
    **{"_ns": 1e-9, "_nsec": 1e-9, "_us": 1e-6, "_µs": 1e-6, "_usec": 1e-6, "_ms": 1e-3},
    **{"_msec": 1e-3, "_s": 1.0, "_sec": 1.0, "_secs": 1.0, "_seconds": 1.0, "": 1.0},
}
"""Length of a unit of time in seconds, by the end of the column's name."""

TIMES = (
    *("time", "timestamp", "timestamps", "t", "seconds", "stamp"),
    *("sim_time", "ros_time", "wall_time", "elapsed_time", "elapsed", "relative_time"),
)
FRAMES = (
    *("frame", "frame_index", "frame_id", "frame_idx", "frame_number"),
    *("step", "step_index", "step_idx"),
)
EPISODES = ("video", "file", "filename")
EPISODE = "episode"
"""Names of columns that are no actions, without the unit at their end."""

MOST_COLUMNS = 4096
"""Columns of a table. One with more has its frames side by side instead of one below the other."""

DELIMITERS = (b",", b";", b"\t")

_DECIMAL_COMMA, _DECIMAL_POINT = (
    re.compile(rb"(?m)(^|;)-?\d*" + c + rb"\d") for c in (b",", b"\\.")
)
"""Numbers between semicolons, as Excel writes them in some countries, and in others."""

ENCODINGS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""Encodings by the bytes that a text begins with."""


def read_table(path: Path) -> Table:
    """Read the columns of a table; a column without a name that counts the rows is left out.

    Raises:
        DataError: the file is missing, damaged, empty, ragged, too wide, or does not name its
            columns.
    """
    check_fetched(path)
    columns: dict[str, NDArray[Any]] = {}
    try:
        rows = _spread(READERS[path.suffix.lower()](path))
        _check_width(len(rows))
        for name, values in _numbered(rows, path).items():
            split = _split(composed(name), values)
            if twice := next((column for column in split if column in columns), None):
                raise DataError(f"{path} has two columns called {twice}: give them other names")
            columns |= split
            _check_width(len(columns))
    except FileNotFoundError:
        raise DataError(f"there is no {path}") from None
    except UnicodeDecodeError:
        raise DataError(f"the table {path} is not in UTF-8: save it in UTF-8") from None
    except (*DAMAGED, arrow.ArrowException) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"the table {path} cannot be read ({reason})") from error
    if len({len(values) for values in columns.values()}) > 1:
        lengths = {name: len(values) for name, values in columns.items()}
        raise DataError(f"the columns of {path} differ in length: {lengths!s:.300}")
    if not any(map(len, columns.values())):
        raise DataError(f"the table {path} holds no row")
    if "" in columns and not _counts(columns[""]):
        raise DataError(f"the table {path} has a column without a name: write one above it")
    return {name: values for name, values in columns.items() if name}


def _counts(column: NDArray[Any]) -> bool:
    """Whether a column is the number of each row, from 0 or 1, as pandas writes it."""
    if column.dtype.kind not in "iu" or not len(column):
        return False
    return column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def _check_width(count: int) -> None:
    if count > MOST_COLUMNS:
        raise ValueError(
            f"it has {count:,} columns, but at most {MOST_COLUMNS:,} are read: a row is a moment"
        )


def numbers(table: Table, names: Sequence[str], path: Path) -> NDArray[np.float64]:
    """The columns `names` as ``[N, len(names)]``.

    Raises:
        DataError: there is no such column, or it holds something else than finite numbers.
    """
    return np.stack([number_column(table, name, path) for name in names], 1)


def number_column(table: Table, name: str, path: Path) -> NDArray[np.float64]:
    """One column ``[N]``; errors as in `numbers`."""
    if name not in table:
        raise DataError(f"{path} has no column {name!r}{suggest(name, table)}")
    column = table[name]
    if column.dtype.kind not in "fiub":
        example = next((value for value in column.tolist() if not _is_number(value)), None)
        raise DataError(f"the column {name} of {path} holds {example!r:.80}, which is not a number")
    values = column.astype(np.float64)
    if len(bad := np.flatnonzero(~np.isfinite(values))):
        raise DataError(
            f"the column {name} of {path} has no finite number in row {bad[0]} (counted from 0)"
        )
    return values


def holds_numbers(column: NDArray[Any]) -> bool:
    """Whether a column holds numbers, at least some: one wrong word does not make it text."""
    values = column.tolist()
    return column.dtype.kind in "fiub" or any(
        _is_number(value.replace(",", "") if isinstance(value, str) else value) for value in values
    )


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def special_column(table: Table, names: Sequence[str]) -> str | None:
    """The first column that has one of `names`, perhaps with a unit of time at its end."""
    return next((name for name in table if _bare(name) in names), None)


def episode_column(table: Table) -> str | None:
    """The column that tells the episode of each row, if there is one."""
    return next((name for name in table if _is_episode(name)), None)


def _is_episode(name: str) -> bool:
    return plain(name) in NUMBERS or _bare(name) in EPISODES


def action_columns(table: Table) -> list[str]:
    """The columns that are neither times nor numbers of frames or episodes."""
    return [n for n in table if _bare(n) not in (*TIMES, *FRAMES) and not _is_episode(n)]


def _flat(name: str, values: Any) -> dict[str, Any]:
    """A column, or one for each entry of objects, as ``action.x``.

    Raises:
        ValueError: its rows have different lengths, or entries of other names.
    """
    rows = cast(list[Any], values) if isinstance(values, list) else []
    if not rows or not isinstance(rows[0], dict):
        try:
            return {name: np.asarray(values)}
        except ValueError:
            raise ValueError(f"the rows of {name} have different lengths") from None
    if any(not isinstance(row, dict) or [*row] != [*rows[0]] for row in rows):
        raise ValueError(f"the rows of {name} have different entries")
    entries = ((f"{name}.{key}", [_nan(row[key]) for row in rows]) for key in rows[0])
    return {k: v for entry in entries for k, v in _flat(*entry).items()}


def _spread(rows: Mapping[str, Any]) -> Mapping[str, Any]:
    """The columns, with a text that stands once, as in NPZ and JSON, in every row."""
    arrays = {k: v for entry in rows.items() for k, v in _flat(*entry).items()}
    count = max((len(values) for values in arrays.values() if values.ndim), default=0)
    alone = {n: v for n, v in arrays.items() if v.ndim == 0}
    if wrong := next((name for name, value in alone.items() if value.dtype.kind not in "US"), None):
        raise ValueError(
            f"{wrong} is {alone[wrong]!s:.80}, but a column has a value per row: leave it out"
        )
    return {**arrays, **{name: np.repeat(value, count) for name, value in alone.items()}}


def _numbered(rows: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """The columns, with a number of the episode in place of arrays that say where episodes are."""
    arrays = {name: np.asarray(values) for name, values in rows.items()}
    edges = {n: v for n, v in arrays.items() if divides(n) and v.ndim == 1}
    counts = {len(v) for n, v in arrays.items() if n not in edges and v.ndim}
    if not edges or len(counts) != 1 or {len(v) for v in edges.values()} == counts:
        return rows
    (count,) = counts
    numbering = {name: values for name, values in arrays.items() if _is_episode(name)}
    bounds = bounds_of(edges | numbering, count, f"{path} ({', '.join(edges)})") or [(0, count)]
    numbers = np.zeros(count, np.int64)
    for number, (start, stop) in enumerate(bounds):
        numbers[start:stop] = number
    kept = {name: values for name, values in rows.items() if name not in edges}
    return kept if any(map(_is_episode, kept)) else {**kept, EPISODE: numbers}


def seconds(table: Table, name: str, path: Path) -> NDArray[np.float64]:
    """A column of times in seconds; the end of its name gives the unit, as in ``time_ms``.

    Raises:
        DataError: it is missing, or holds something else than finite numbers.
    """
    unit = SECONDS[_named(name)[1]]
    values = number_column(table, name, path)
    whole = table[name].astype(np.int64) if table[name].dtype.kind in "iu" else None
    if whole is None or unit == 1.0:
        return values * unit
    first = whole[0] // round(1 / unit)  # nanoseconds since 1970 exceed what a float can tell
    return (whole - first * round(1 / unit)) * unit + float(first)


def _bare(name: str) -> str:
    return _named(name)[0]


def _named(name: str) -> tuple[str, str]:
    """A name without the unit of time at its end, as in ``time_ms`` or ``Time [ms]``; and that."""
    plain_name = re.sub(r"[\s_]*[\[(](\w+)[\])]$", r"_\1", name.lower().strip())
    ending = next(ending for ending in SECONDS if plain_name.endswith(ending))
    return plain_name.removesuffix(ending), ending


def _split(name: str, values: Any) -> dict[str, NDArray[Any]]:
    """A column of vectors as one column per entry."""
    array = np.asarray(values)
    if array.ndim == 1:
        return {name: array}
    if array.ndim != 2:
        raise ValueError(f"{name or 'the array'} is {array.shape}: a table has one or two axes")
    _check_width(array.shape[1])
    base = name or "action"
    return {f"{base}_{place}": array[:, place] for place in range(array.shape[1])}


def _csv(path: Path) -> dict[str, Any]:
    csv: Any = importlib.import_module("pyarrow.csv")
    data, delimiter = _without_comments(_utf8(path.read_bytes()))
    head = re.split(rb"[\r\n]", data, maxsplit=1)[0]
    _check_width(head.count(delimiter) + 1)
    _check_head(head)
    _check_delimiter(data, delimiter)
    commas = delimiter == b";" and _DECIMAL_COMMA.search(data) and not _DECIMAL_POINT.search(data)
    try:
        table = csv.read_csv(
            arrow.BufferReader(data),
            parse_options=csv.ParseOptions(delimiter=delimiter.decode()),
            convert_options=csv.ConvertOptions(
                strings_can_be_null=True, decimal_point="," if commas else "."
            ),
        )
    except arrow.ArrowInvalid as error:
        if ragged := re.search(r"Expected (\d+) columns, got (\d+)", str(error)):
            raise ValueError(
                f"its first line has {ragged[1]} fields, and another one {ragged[2]}: remove what "
                "stands above the names of the columns, or begin it with #"
            ) from error
        raise
    columns = _columns(table)
    _check_names(columns)
    return columns


def _utf8(data: bytes) -> bytes:
    """A text in UTF-8 without a mark, told by its first bytes; UTF-16 is what Excel writes."""
    for mark, encoding in ENCODINGS.items():
        if data.startswith(mark):
            return data.decode(encoding).encode()
    if b"\0" in data[:2]:
        return data.decode("utf-16-be" if data[:1] == b"\0" else "utf-16-le").encode()
    return data


def _without_comments(data: bytes) -> tuple[bytes, bytes]:
    """The lines of a CSV file but for comments, and its delimiter.

    A comment begins with #, and has a space after it or other fields than the header. The last one
    before the numbers is the header if it has as many fields as they, as `numpy.savetxt` writes it.
    """
    data = data.lstrip(b"\r\n")
    separator = data[4:5] if data[:4].lower() == b"sep=" else b""  # a first line for Excel
    if not separator and not re.search(rb"(^|[\r\n])[ \t]*#", data):
        return data, max(DELIMITERS, key=re.split(rb"[\r\n]", data, maxsplit=1)[0].count)
    lines, comments = data.splitlines(), list[bytes]()
    if separator:
        lines.pop(0)
    while lines and (lines[0].lstrip().startswith(b"#") or not lines[0].strip()):
        comments.append(lines.pop(0).lstrip(b"# \t"))
    if not lines:
        return data, b","
    delimiter = separator or max(DELIMITERS, key=lines[0].count)
    count = lines[0].count(delimiter)
    header = next((comment for comment in reversed(comments) if comment.strip()), b"")
    if header.count(delimiter) == count and all(map(_is_number, lines[0].split(delimiter))):
        lines.insert(0, header)
    kept = (line for line in lines if not _is_comment(line, delimiter, count))
    return b"\n".join(kept), delimiter


def _is_comment(line: bytes, delimiter: bytes, count: int) -> bool:
    """Whether a line is one, and no row whose first field is a text such as #ff0000."""
    text = line.lstrip()
    return text[:1] == b"#" and (text[1:2].isspace() or text.count(delimiter) != count)


def _check_delimiter(data: bytes, delimiter: bytes) -> None:
    """Refuse rows of several numbers without a delimiter that is known."""
    lines = data.splitlines()[:2]
    fields = re.split(rb"[\s|]+", lines[-1].strip()) if lines else []
    if lines and delimiter not in lines[0] and len(fields) > 1 and all(map(_is_number, fields)):
        raise ValueError("its numbers are separated by neither commas, semicolons nor tabs")


def _check_head(head: bytes) -> None:
    """Refuse a first line of numbers: it is no header, and would be lost."""
    cells = re.split(r"[,;\t]", head.decode("utf-8-sig", "replace").strip())
    cells = [cell.strip().strip("\"'") for cell in cells]
    whole = all(map(_is_number, filter(None, cells))) and any(cells)
    if whole or any(re.fullmatch(r"-?\d*\.\d+(e-?\d+)?", cell) for cell in cells):
        first_cells = ", ".join(cells[:4])
        raise ValueError(
            f"its first line holds numbers ({first_cells}): write the names of the columns above it"
        )


def _check_names(columns: Mapping[str, NDArray[Any]]) -> None:
    """Refuse names of which some are numbers, and the others stand above text: a row of data."""
    numbers = [name for name in columns if name and _is_number(name)]
    words = [name for name in columns if name and name not in numbers]
    above_text = not any(holds_numbers(columns[name]) for name in words)
    if numbers and words and above_text and all(holds_numbers(columns[n]) for n in numbers):
        first_names = ", ".join([*columns][:4])
        raise ValueError(
            f"its first line is a row ({first_names}): write the names of the columns above"
        )


def _parquet(path: Path) -> dict[str, Any]:
    return _columns(read_parquet(path))


def read_parquet(
    path: Path, columns: Sequence[str] | None = None, episode: tuple[str, int] | None = None
) -> Any:
    """A Parquet file as a table of Arrow.

    Args:
        path: the file.
        columns: those to read; all by default.
        episode: a column and its value in the rows to read; all by default.

    Raises:
        ValueError: they would unpack to far more than is stored; or it is no such file.
        OSError: it cannot be read.
    """
    size, unpacked = path.stat().st_size, 0
    with parquet_file(path) as file:
        about, names = file.metadata, [*columns] if columns else None
        groups = range(about.num_row_groups)
        if episode is not None:
            groups = [place for place in groups if _may_hold(about.row_group(place), *episode)]
        read: list[Any] = []
        for batch in file.iter_batches(_rows_at_once(file.schema, names), groups, names):
            unpacked += batch.nbytes  # a value may be stored once for all rows
            check_unpacked(size, unpacked)
            read.append(batch)
        schema = file.schema_arrow
        if names is not None:
            schema = arrow.schema([schema.field(name) for name in names])
    table = arrow.Table.from_batches(read, schema=read[0].schema if read else schema)
    if episode is None:
        return table
    compute: Any = importlib.import_module("pyarrow.compute")
    return table.filter(compute.equal(table.column(episode[0]), episode[1]))


def _rows_at_once(schema: Any, names: Sequence[str] | None) -> int:
    """Few rows of columns with values of any size, such as texts and pictures."""
    columns = [schema.column(place) for place in range(len(schema))]
    read = [
        c for c in columns if names is None or c.path.partition(".")[0] in names or c.path in names
    ]
    return 16 if any(column.physical_type == "BYTE_ARRAY" for column in read) else 2**16


def _may_hold(group: Any, name: str, value: int) -> bool:
    """Whether the statistics of a row group allow a value."""
    for place in range(group.num_columns):
        column = group.column(place)
        known = column.statistics if column.path_in_schema == name else None
        if known is not None and known.has_min_max:
            return known.min <= value <= known.max
    return True


def parquet_file(path: Path) -> Any:
    """A Parquet file, whose columns unpack to no more than they may.

    Raises:
        ValueError: they would unpack to far more than is stored; or it is no such file.
        OSError: it cannot be read.
    """
    parquet: Any = importlib.import_module("pyarrow.parquet")
    file = parquet.ParquetFile(path)
    about = file.metadata
    _check_width(about.num_columns)
    groups = [about.row_group(place) for place in range(about.num_row_groups)]
    values = sum(g.column(place).num_values for g in groups for place in range(g.num_columns))
    check_unpacked(path.stat().st_size, 8 * max(values, about.num_rows * about.num_columns))
    return file


def _columns(table: Any) -> dict[str, Any]:
    """The columns of an Arrow table; an empty field is NaN among numbers."""
    types = arrow.types
    arrays: dict[str, Any] = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if name in arrays:
            raise ValueError(f"it has two columns called {name or 'nothing'}: name them apart")
        if types.is_nested(column.type):
            arrays[name] = column.to_pylist()
        elif types.is_temporal(column.type):
            raise ValueError(f"the column {name} holds dates, not numbers: write times in seconds")
        else:
            arrays[name] = column.to_numpy()
    return arrays


def _npy(path: Path) -> dict[str, Any]:
    return {"": load_npy(path)}


def _npz(path: Path) -> dict[str, Any]:
    return dict(load_npz(path))


def _json(path: Path) -> dict[str, Any]:
    return _records(_parsed(path.read_bytes()))


def _jsonl(path: Path) -> dict[str, Any]:
    lines = _utf8(path.read_bytes()).splitlines()
    return _records([_parsed(line) for line in lines if line.strip()])


def _parsed(data: bytes) -> Any:
    content = parse_json(data)  # which keeps the last of two entries of one name
    json.loads(data, object_pairs_hook=_unlike)
    return content


def _unlike(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict[str, Any]()
    for name, value in pairs:
        if name in entries:
            raise ValueError(f"it has two columns called {name}: name them apart")
        entries[name] = value
    return entries


def _records(value: Any) -> dict[str, Any]:
    """Columns of a dict of lists, a list of objects with the same keys, or a list of rows."""
    if isinstance(value, dict):
        return cast(dict[str, Any], value)
    if not isinstance(value, list) or not value:
        raise ValueError("it is neither a list of rows nor an object of columns")
    rows = cast(list[Any], value)
    if not isinstance(rows[0], dict):
        return {"": np.array(rows)}
    names = list(cast(dict[str, Any], rows[0]))
    for place, row in enumerate(rows):
        if not isinstance(row, dict) or [*cast(dict[str, Any], row)] != names:
            raise ValueError(f"row {place} (counted from 0) has different columns from the first")
    return {name: [_nan(row[name]) for row in rows] for name in names}


def _nan(value: Any) -> Any:
    return float("nan") if value is None else value


DAMAGED = (
    *(OSError, ValueError, LookupError, EOFError, TypeError, ArithmeticError, MemoryError),
    RuntimeError,
)
"""What reading a damaged table raises."""

READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".csv": _csv,
    ".tsv": _csv,
    ".npy": _npy,
    ".npz": _npz,
    ".json": _json,
    ".jsonl": _jsonl,
    ".parquet": _parquet,
}
"""Reads the columns of a file, by the end of its name."""
