"""Runs a command on disks that are too small; run in a mount namespace of its own.

`unshare --map-root-user --mount python filling.py FOLDER SIZES COMMAND...` prints a line of JSON
for each size in kB: how the command ended, what it said and which files there are. DISK in the
command is the disk.
"""

import json
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner

from acwm_core.cli import main

if __name__ == "__main__":
    disk, sizes, *command = sys.argv[1:]
    for size in map(int, sizes.split(",")):
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", disk], check=True)
        result = CliRunner().invoke(main, [each.replace("DISK", disk) for each in command])
        files = sorted(str(p.relative_to(disk)) for p in Path(disk).rglob("*") if p.is_file())
        found = {"size": size, "code": result.exit_code, "said": result.stderr, "files": files}
        print(json.dumps({**found, "error": repr(result.exception)}), flush=True)
        subprocess.run(["umount", "--lazy", disk], check=True)  # an error may hold files open
