"""What tests ask of folders and of processes."""

import hashlib
import time
from pathlib import Path


def checksums(folder):
    """SHA-256 of every file of a data folder but its lock."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def wait_until(condition, process=None, seconds=600):
    """Poll until something is so; `process`, if it is given, must not end before."""
    deadline = time.monotonic() + seconds
    while True:
        ended = process is not None and process.poll() is not None  # perhaps well, so ask first
        if condition():
            return
        assert not ended, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
