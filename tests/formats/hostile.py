"""Files that do harm: bombs, claims of more than there is, and what is no file."""

import io
import json
import os
import struct
import zipfile

import numpy as np
import pyarrow
import pyarrow.parquet

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 64\n{ } loop\n"
DEEP = b"[" * 10**5 + b"]" * 10**5


def npy(shape, data=b"", dtype="<f8"):
    """A ``.npy`` file that claims a shape."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header = header.ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def npz(**members):
    """An ``.npz`` file of the bytes of its members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return file.getvalue()


def gif(width, height, frames):
    """A GIF whose frames change one pixel each of a large picture."""
    data = b"GIF89a" + struct.pack("<HHBBB", width, height, 0x80, 0, 0) + bytes(6)
    for _ in range(frames):
        data += b"\x21\xf9\x04\x00" + struct.pack("<H", 10) + b"\x00\x00"
        data += b"\x2c" + struct.pack("<HHHHB", 0, 0, 1, 1, 0) + b"\x02\x02\x44\x01\x00"
    return data + b"\x3b"


def parquet():
    """A Parquet file of 40 million equal rows, which take no place."""
    constant = pyarrow.DictionaryArray.from_arrays(
        pyarrow.repeat(pyarrow.scalar(0, pyarrow.int32()), 10**7), pyarrow.array([1.0])
    )
    file = io.BytesIO()
    schema = pyarrow.schema([("x", constant.type)])
    with pyarrow.parquet.ParquetWriter(file, schema) as writer:
        for _ in range(4):
            writer.write_table(pyarrow.table({"x": constant}), row_group_size=10**7)
    return file.getvalue()


def repeated():
    """A Parquet file of one long text for all of its rows."""
    rows = pyarrow.array(np.zeros(10**4, np.int32))
    text = pyarrow.DictionaryArray.from_arrays(rows, pyarrow.array(["x" * 10**5]))
    file = io.BytesIO()
    table = pyarrow.table({"x": pyarrow.array([0.0] * 10**4), "note": text})
    pyarrow.parquet.write_table(table, file)
    return file.getvalue()


def wide(columns):
    """A CSV of many columns."""
    names = ",".join(f"x{i}" for i in range(columns))
    return f"{names}\n{','.join('1' * columns)}\n".encode()


TABLES = {
    "a.npy of 10^15 numbers": npy((10**15,)),
    "b.npy of 10^15 columns": npy((0, 10**15)),
    "c.npy of objects": npy((3,), bytes(24), "|O"),
    "d.npz of 10^15 numbers": npz(actions=npy((10**12, 1000))),
    "e.npz of zeros": lambda: npz(actions=npy((2**25 + 2**20,), bytes(2**28 + 2**23))),
    "f.npz of no array": npz(actions=b"hello"),
    "g.csv of 10^5 columns": wide(10**5),
    "h.json that is deep": b'{"x":' + DEEP + b"}",
    "i.jsonl that is deep": DEEP,
    "j.json of a long number": b'{"x": [1' + b"0" * 4000 + b"]}",
    "k.json of many columns": json.dumps({f"x{i}": [1] for i in range(10**5)}).encode(),
    "l.parquet of equal rows": parquet,
    "l.parquet of one long text": repeated,
    "m.npy of structures": npy((1,), bytes(8)).replace(b"'<f8'", b"[('a', '<f8')]"),
    "n.csv of one long field": b"x,y\n1," + b"9" * 10**6 + b"\n",
    "o.npy of three axes": npy((2, 2, 2), bytes(64)),
    "p.json of nothing": b"null",
    "q.npz of nothing": npz(),
}
"""Tables that do harm, the large ones as functions; a name begins with that of the file."""


def pipe(path):
    """Put a pipe in the place of a file, which nobody writes to."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def link(path):
    """Put a link to a file outside of the folder in its place."""
    outside = path.parents[len(path.parts) - 1 - path.parts.index("source")] / path.name
    path.rename(outside)
    path.symlink_to(outside)


def pointer(path):
    """Put what Git LFS writes in the place of a file."""
    path.write_bytes(POINTER)
