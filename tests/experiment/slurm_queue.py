"""Stands in for SLURM: jobs run here, one process each, as soon as those they depend on have ended.

`install(FOLDER)` writes sbatch, squeue, scancel, scontrol and srun into FOLDER/bin. They honour
--dependency=afterok|afterany|singleton, --kill-on-invalid-dep, --output in append mode, and
`scontrol requeue`; `preempt(FOLDER, JOB)` does what `#SBATCH --signal=USR1@300` announces.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

ENDED = ("COMPLETED", "FAILED", "CANCELLED")


def sbatch(here, *arguments):
    script = Path(arguments[-1])
    after = [a.partition("=")[2] for a in arguments if a.startswith("--dependency=")]
    job = str(100 + len(list((here / "jobs").iterdir())))
    folder = here / "jobs" / job
    folder.mkdir()
    (folder / "arguments").write_text(" ".join(arguments))
    put_state(here, job, "PENDING")
    command = [sys.executable, "-I", "-S", __file__, "watch", str(here), job, str(script), *after]
    log = (folder / "watch.log").open("w")
    subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    print(f"{job};cluster")


def watch(here, job, script, after=""):
    """Wait for what the job depends on, run it, and again when it is queued again."""
    folder = here / "jobs" / job
    condition, *needed = after.split(":")
    if condition == "singleton":
        older = [each.name for each in (here / "jobs").iterdir() if int(each.name) < int(job)]
        needed = [each for each in older if name(here, each) == name(here, job)]
    while not all(state(here, each) in ENDED for each in needed):
        if state(here, job) == "CANCELLED":
            return
        time.sleep(0.01)
    invalid = condition == "afterok" and any(state(here, n) != "COMPLETED" for n in needed)
    if invalid:
        assert "--kill-on-invalid-dep=yes" in Path(script).read_text()
        put_state(here, job, "CANCELLED")
        return
    text, restarts = Path(script).read_text(), 0
    assert "--open-mode=append" in text
    while True:
        put_state(here, job, "RUNNING")
        environment = {
            **os.environ, "SLURM_JOB_ID": job, "SLURM_RESTART_COUNT": str(restarts),
            "SLURM_NTASKS": "1", "SLURM_PROCID": "0", "SLURM_LOCALID": "0", "SLURM_NODEID": "0",
            "SLURM_JOB_NAME": "job", "SLURM_NNODES": "1", "SLURM_NTASKS_PER_NODE": "1",
        }  # fmt: skip
        with Path(re.search(r"--output=(\S+)", text)[1]).open("a") as log:
            process = subprocess.Popen(
                ["bash", script], env=environment, stdin=subprocess.DEVNULL,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
            (folder / "pid").write_text(str(process.pid))
            code = process.wait()
        if not (folder / "requeue").exists():
            break
        (folder / "requeue").unlink()
        restarts += 1
    if state(here, job) != "CANCELLED":
        put_state(here, job, "FAILED" if code else "COMPLETED")


def squeue(here, *arguments):
    assert arguments == ("--me", "--noheader", "--format=%i %T")
    for folder in sorted((here / "jobs").iterdir()):
        if state(here, folder.name) not in ENDED:
            print(folder.name, state(here, folder.name))


def scancel(here, job):
    put_state(here, job, "CANCELLED")
    pid = here / "jobs" / job / "pid"
    if pid.exists():
        os.killpg(int(pid.read_text()), signal.SIGKILL)


def scontrol(here, command, job):
    assert command == "requeue"
    (here / "jobs" / job / "requeue").touch()


def srun(here, *command):
    (here / "jobs" / os.environ["SLURM_JOB_ID"] / "step").write_text(str(os.getpid()))
    os.execvp(command[0], command)


def preempt(here, job):
    os.kill(int((here / "jobs" / job / "step").read_text()), signal.SIGUSR1)


def name(here, job):
    script = (here / "jobs" / job / "arguments").read_text().split()[-1]
    return re.search(r"--job-name=(\S+)", Path(script).read_text())[1]


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
