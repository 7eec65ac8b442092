"""Stands in for SLURM: jobs run here, one process per element, when those they wait for have ended.

`install(FOLDER)` writes sbatch, squeue, scancel, scontrol and srun into FOLDER/bin. They know what
SLURM knows of a script (arrays, dependencies, where to print) from its `#SBATCH` lines, the later
of which counts, and honour `scontrol requeue`. `preempt(FOLDER, JOB)` does what `--signal=USR1@300`
announces. Elements that FOLDER/unlucky names are killed in the first job.
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

ENDED = ("COMPLETED", "FAILED", "CANCELLED")
FIRST = 100


def sbatch(here, script):
    job = str(FIRST + len(list((here / "jobs").iterdir())))
    folder = here / "jobs" / job
    folder.mkdir()
    (folder / "script").write_text(Path(script).read_text())
    refused = options(here, job).get("partition") == "none"
    put_state(here, job, "FAILED" if refused else "PENDING")
    if refused:
        sys.exit("sbatch: error: invalid partition specified")
    log = (folder / "watch.log").open("w")
    command = [sys.executable, "-I", "-S", __file__, "watch", str(here), job]
    subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    print(f"Submitted batch job {job} on cluster here")


def options(here, job):
    """What the `#SBATCH` lines say before the first command."""
    found = {}
    for line in (here / "jobs" / job / "script").read_text().splitlines():
        if line and not line.startswith("#"):
            break
        for option in shlex.split(line.removeprefix("#SBATCH ") if "#SBATCH" in line else ""):
            name, _, value = option.removeprefix("--").partition("=")
            found[name] = value
    return found


def watch(here, job):
    """Wait for what the job depends on, run it, and again when it is queued again."""
    folder, asked = here / "jobs" / job, options(here, job)
    condition, *needed = asked.get("dependency", "").split(":")
    if condition == "singleton":
        older = [each.name for each in (here / "jobs").iterdir() if int(each.name) < int(job)]
        needed = [n for n in older if options(here, n)["job-name"] == asked["job-name"]]
    while not all(state(here, each) in ENDED for each in needed):
        if state(here, job) == "CANCELLED":
            return
        time.sleep(0.01)
    if condition == "afterok" and any(state(here, n) != "COMPLETED" for n in needed):
        assert asked["kill-on-invalid-dep"] == "yes"
        put_state(here, job, "CANCELLED")
        return
    restarts = 0
    while True:
        put_state(here, job, "RUNNING")
        processes = [start(here, job, element, restarts) for element in elements(asked)]
        (folder / "pids").write_text("\n".join(str(process.pid) for process in processes))
        failed = any([process.wait() for process in processes])  # all of them
        if not (folder / "requeue").exists():
            break
        (folder / "requeue").unlink()
        restarts += 1
    if state(here, job) != "CANCELLED":
        put_state(here, job, "FAILED" if failed else "COMPLETED")


def elements(asked):
    first, last = re.match(r"(\d+)-(\d+)", asked["array"]).groups() if "array" in asked else (0, -1)
    return [*range(int(first), int(last) + 1)] or [None]


def start(here, job, element, restarts):
    environment = {
        **os.environ, "SLURM_JOB_ID": job, "SLURM_RESTART_COUNT": str(restarts),
        "SLURM_NTASKS": "1", "SLURM_PROCID": "0", "SLURM_LOCALID": "0", "SLURM_NODEID": "0",
        "SLURM_JOB_NAME": "job", "SLURM_NNODES": "1", "SLURM_NTASKS_PER_NODE": "1",
    }  # fmt: skip
    asked = options(here, job)
    output = asked["output"].replace("%j", job).replace("%A", job).replace("%a", str(element))
    command = ["bash", str(here / "jobs" / job / "script")]
    unlucky = here / "unlucky"
    if element is not None:
        environment |= {"SLURM_ARRAY_JOB_ID": job, "SLURM_ARRAY_TASK_ID": str(element)}
        if int(job) == FIRST and unlucky.exists() and str(element) in unlucky.read_text().split():
            command = ["bash", "-c", "kill -9 $$"]
    assert asked["open-mode"] == "append"
    with Path(output).open("a") as log:
        return subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            start_new_session=True,
        )  # fmt: skip


def squeue(here, *arguments):
    assert arguments == ("--me", "--noheader", "--format=%F %T")
    for folder in sorted((here / "jobs").iterdir()):
        if state(here, folder.name) not in ENDED:
            print(folder.name, state(here, folder.name))


def scancel(here, job):
    put_state(here, job, "CANCELLED")
    pids = here / "jobs" / job / "pids"
    for pid in pids.read_text().split() if pids.exists() else ():
        os.killpg(int(pid), signal.SIGKILL)


def scontrol(here, command, job):
    assert command == "requeue"
    (here / "jobs" / job / "requeue").touch()


def srun(here, *words):
    words = [*words]
    while words[0].startswith("--"):
        option = words.pop(0)
        if option == "--output":
            output = words.pop(0)
        elif option == "--open-mode":
            assert words.pop(0) == "append"
    with Path(output).open("a") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    (here / "jobs" / os.environ["SLURM_JOB_ID"] / "step").write_text(str(os.getpid()))
    os.execvp(words[0], words)


def preempt(here, job):
    os.kill(int((here / "jobs" / job / "step").read_text()), signal.SIGUSR1)


def put_state(here, job, state):
    """Whole at once, as others read it."""
    new = here / f"state-{job}-{os.getpid()}"
    new.write_text(state)
    new.rename(here / "jobs" / job / "state")


def state(here, job):
    return (here / "jobs" / job / "state").read_text()


def install(here):
    """Returns the folder for PATH."""
    (here / "jobs").mkdir(parents=True)
    (here / "bin").mkdir()
    for name in ("sbatch", "squeue", "scancel", "scontrol", "srun"):
        command = here / "bin" / name
        client = f'exec {sys.executable} -I -S {__file__} {name} {here} "$@"'
        command.write_text(f"#!/bin/bash\n{client}\n")
        command.chmod(0o755)
    return here / "bin"


if __name__ == "__main__":
    functions = {f.__name__: f for f in (sbatch, watch, squeue, scancel, scontrol, srun)}
    functions[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
