"""Scripts as processes of their own, forked from one that has imported what takes seconds."""

import multiprocessing
import os
import runpy
import sys
from multiprocessing import forkserver
from pathlib import Path

SLOW = ["torch", "lightning", "torchmetrics", "matplotlib.pyplot", "scipy.optimize", "gymnasium"]
"""Other libraries: nothing of acwm, so that a script has to import what it uses."""

CONTEXT = multiprocessing.get_context("forkserver")


def start_server():
    """Let this process's workers, too, be forked from a process with these libraries."""
    CONTEXT.set_forkserver_preload(SLOW)
    forkserver.ensure_running()


def run_script(script, folder, **environment):
    """Run a script in a folder, which must succeed."""
    start_server()
    said = folder / "said.txt"
    process = CONTEXT.Process(target=_become, args=(str(script), folder, said, environment))
    process.start()
    process.join(600)
    assert process.exitcode == 0, said.read_text() if said.exists() else process.exitcode


def _become(script, folder, said, environment):
    os.environ.update(environment)
    os.chdir(folder)
    file = os.open(said, os.O_WRONLY | os.O_CREAT)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.argv = [script]
    sys.path[:0] = [str(Path(script).parent)]
    runpy.run_path(script, run_name="__main__")
