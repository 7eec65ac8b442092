"""``python -m tests.training.train_many DATA JOBS…``: one `fit` after another, on two ranks.

JOBS is a JSON list of ``{"run": folder, "sections": …, "resume": folder or null, "spared": …}``.
Starting processes takes longer than training tiny models, so several runs share them, and all
processes are forked from this one, which has imported everything, with the variables that torchrun
sets. The first rank prints a JSON list: for each job null, or the error that ended it. The last
line is the exit codes of both ranks for each JOBS.
"""

import contextlib
import json
import multiprocessing
import os
import socket
import sys

from acwm_core.catalog import catalog
from acwm_core.errors import AcwmError
from acwm_core.training.launch import fit
from tests.training.tiny import TinyPlugin, tiny_recipe


def outcome(data: str, job: dict) -> str | None:
    os.environ.pop("SPARED", None)
    if job.get("spared"):
        os.environ["SPARED"] = "1"
    try:
        fit(tiny_recipe(data, **job.get("sections", {})), job["run"], resume=job.get("resume"))
    except AcwmError as error:
        return f"{error.exit_code}: {error}"
    except SystemExit as ended:  # a rank after the first
        return f"{ended.code}"
    return None


def rank(number: int, ports: list[int], data: str, jobs: list[dict]) -> None:
    """Each job has a port of its own: the rank that is ahead would find the store of the last."""
    os.environ |= {"RANK": str(number), "LOCAL_RANK": str(number)}
    outcomes: list[str | None] = []
    for port, job in zip(ports, jobs, strict=True):
        os.environ["MASTER_PORT"] = str(port)
        outcomes.append(outcome(data, job))
    if number == 0:
        print(json.dumps(outcomes), flush=True)


def free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in held:
            each.bind(("localhost", 0))
        return [each.getsockname()[1] for each in held]


def main(data: str, *launches: str) -> None:
    catalog().add_plugin(TinyPlugin, "tiny_training_parts")
    context, codes = multiprocessing.get_context("fork"), []
    for launch in launches:
        jobs = json.loads(launch)
        ports = free_ports(len(jobs))
        ranks = [context.Process(target=rank, args=(n, ports, data, jobs)) for n in (0, 1)]
        for each in ranks:
            each.start()
        for each in ranks:
            each.join(180)
            each.kill()  # if it hangs
            each.join()
        codes.append([each.exitcode for each in ranks])
    print(json.dumps(codes))


if __name__ == "__main__":
    main(*sys.argv[1:])
