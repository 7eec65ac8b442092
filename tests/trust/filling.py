"""Runs a command on disks that are too small; run in a mount namespace of its own.

`unshare --map-root-user --mount python filling.py FOLDER SIZES BEFORE COMMAND...` prints a line of
JSON for each size in kB: how the command ended, what it said, which files there are, and how the
same command ended once there was room. DISK in the command is the disk. If BEFORE names a folder,
the disk holds a copy of it, called ``before``, and so much more has room.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner

from acwm_core.cli import main

ROOM = "size=64m"


def mount(folder, options):
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)


def files(folder):
    return sorted(str(p.relative_to(folder)) for p in Path(folder).rglob("*") if p.is_file())


def tried(size, disk, before, words):
    """How the command ends, without room and then with it."""
    mount(disk, ROOM)
    if before:
        shutil.copytree(before, Path(disk, "before"))
    mount(disk, f"remount,size={shutil.disk_usage(disk).used // 1024 + size}k")
    result = CliRunner().invoke(main, words)
    found = {"size": size, "code": result.exit_code, "said": result.stderr, "files": files(disk)}
    found |= {"error": repr(result.exception), "again": 0, "more": ""}
    if result.exit_code:
        mount(disk, f"remount,{ROOM}")
        again = CliRunner().invoke(main, words)
        found |= {"again": again.exit_code, "more": again.stderr, "whole": files(disk)}
    subprocess.run(["umount", "--lazy", disk], check=True)  # an error may hold files open
    return found


if __name__ == "__main__":
    folder, sizes, before, *command = sys.argv[1:]
    sys.path.insert(0, str(Path(__file__).parents[2]))
    if {"fit", "plan", "rank", "ship"} & {*command}:
        from tests.tiny import register

        register()
    for each in map(int, sizes.split(",")):
        words = [word.replace("DISK", folder) for word in command]
        print(json.dumps(tried(each, folder, before, words)), flush=True)
