"""Generates onto disks that are too small, then larger; run in a mount namespace of its own.

`unshare --map-root-user --mount python filling_disks.py FOLDER` prints a line of JSON for each size
of the disk: its size in kB, what the command said, and the files and their checksums in the end.
"""

import json
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from conftest import checksums
from generating import run

from acwm_core.errors import DataError


def mount(disk, kilobytes, how):
    options = f"{how}size={kilobytes}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", disk], check=True)


def fill(disk, kilobytes):
    mount(disk, kilobytes, "")
    out, said = disk / "data", None
    try:
        run(out, "square", workers=0)
    except DataError as error:
        said = str(error)
    half = checksums(out) if out.exists() else {}
    mount(disk, 10_000, "remount,")
    run(out, "square", workers=0)
    print(json.dumps({"kilobytes": kilobytes, "said": said, "half": half, "whole": checksums(out)}))
    subprocess.run(["umount", disk], check=True)


if __name__ == "__main__":
    place = Path(sys.argv[1])
    for size in range(4, 420, 20):
        fill(place, size)
