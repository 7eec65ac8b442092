"""Stands in for SLURM's commands: sbatch runs an array's script here, one process per element.

`python slurm_on_this_machine.py install FOLDER` writes sbatch, squeue and scancel into FOLDER. They
keep a line for each element's process in FOLDER/jobs, honour --array and --output as sbatch does,
and, if FOLDER/unlucky is there, kill each element that it names in the first attempt.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path


def sbatch(here, *arguments):
    script = Path(arguments[-1])
    (here / "options").write_text(" ".join(arguments))
    text = script.read_text()
    first, last = map(int, re.search(r"--array=(\d+)-(\d+)", text).groups())
    output = re.search(r"--output=(\S+)", text)[1]
    job = str(100 + len(list((here / "jobs").iterdir())))
    pids = []
    for element in range(first, last + 1):
        environment = {
            **os.environ, "SLURM_ARRAY_TASK_ID": str(element), "SLURM_ARRAY_JOB_ID": job,
        }  # fmt: skip
        command = ["bash", str(script)]
        if "job-1.sh" in str(script) and str(element) in unlucky(here):
            command = ["bash", "-c", "kill -9 $$"]
        with Path(output.replace("%a", str(element))).open("w") as log:
            pids.append(
                subprocess.Popen(
                    command, env=environment, stdout=log, stderr=log, start_new_session=True
                ).pid
            )
    (here / "jobs" / job).write_text("\n".join(map(str, pids)))
    print(f"{job};cluster")


def squeue(here, *arguments):
    job = arguments[arguments.index("--jobs") + 1]
    if not (here / "jobs" / job).exists():
        sys.exit("slurm_load_jobs error: Invalid job id specified")
    for pid in running(here, job):
        print(job, pid, "RUNNING")


def scancel(here, job):
    for pid in running(here, job):
        os.killpg(pid, signal.SIGKILL)


def running(here, job):
    found = []
    for pid in map(int, (here / "jobs" / job).read_text().split()):
        state = Path(f"/proc/{pid}/stat")
        if state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z":
            found.append(pid)
    return found


def unlucky(here):
    return (here / "unlucky").read_text().split() if (here / "unlucky").exists() else []


def install(folder):
    (folder / "jobs").mkdir(parents=True)
    for name in ("sbatch", "squeue", "scancel"):
        command = folder / name
        command.write_text(f'#!/bin/bash\nexec {sys.executable} {__file__} {name} {folder} "$@"\n')
        command.chmod(0o755)


if __name__ == "__main__":
    {"sbatch": sbatch, "squeue": squeue, "scancel": scancel}[sys.argv[1]](
        Path(sys.argv[2]), *sys.argv[3:]
    )
