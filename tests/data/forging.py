"""Datasets as somebody with bad intentions would make them: every checksum is right."""

import contextlib
import hashlib
import io
import json
import tarfile
import zipfile
import zlib
from dataclasses import asdict

import numpy as np
import yaml

from acwm_core.data.card import MANIFEST
from acwm_core.data.dataset import Manifest, action_statistics
from acwm_core.data.shards import ShardRecord
from acwm_core.errors import DataError
from acwm_formats.check import check_dataset


def problems(folder, **options):
    """What `acwm data check` finds wrong, by what it looked at."""
    return {f.what: f.problem for f in check_dataset(folder, **options) if f.problem}


def npy(array):
    """The bytes of a ``.npy`` file, pickled if it must be."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=array.dtype == object)
    return buffer.getvalue()


def zipped(contents, method=zipfile.ZIP_STORED):
    """A zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def replaced(name, data):
    """A change that gives the member `name` other bytes."""
    return lambda info, content: (info, data if info.name == name else content)


def forge(folder, change, split="train", number=0):
    """Rewrite a shard member by member; `change` takes a header and bytes and returns both."""
    path = folder / split / f"shard-{number:05d}.tar"
    with tarfile.open(path) as tar:
        members = [(info, tar.extractfile(info).read()) for info in tar]
    with tarfile.open(path, "w") as tar:
        crc = {}
        for old, content in members:
            info, data = change(tarfile.TarInfo(old.name), content)
            if old.name.endswith(".json"):
                try:
                    about = json.loads(data)
                    about["crc32"] |= crc
                    data = json.dumps(about).encode()
                except (ValueError, TypeError, KeyError, RecursionError):
                    pass  # as the change wants it
                crc = {}
            else:
                crc[old.name.partition(".")[2]] = zlib.crc32(data)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    sign(folder, split, number)


def sign(folder, split="train", number=0, **values):
    """Have manifest and card say of a shard what is true of it, or `values`."""
    path, manifest = folder / split / f"shard-{number:05d}.tar", folder / split / MANIFEST
    lines = [json.loads(line) for line in manifest.read_text().splitlines()]
    if path.exists():
        lines[number]["size"] = path.stat().st_size
        lines[number]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        with contextlib.suppress(DataError, ValueError):  # of what is no shard any more
            sums = asdict(ShardRecord.of_file(path, 0).actions)
            json.dumps(sums, allow_nan=False)
            lines[number]["actions"] = sums
    lines[number] |= values
    manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
    card = yaml.safe_load((folder / "card.yaml").read_text())
    digests = "\n".join(str(line["sha256"]) for line in lines)
    card["checksums"][split] = hashlib.sha256(digests.encode()).hexdigest()
    with contextlib.suppress(DataError):
        card["actions"][split] = action_statistics(Manifest(folder / split).ordered())
    (folder / "card.yaml").write_text(yaml.safe_dump(card))
