"""``python -m tests.training.train_many DATA JOBS…``: one `fit` after another, on two ranks.

JOBS is a JSON list of ``{"run": folder, "sections": …, "resume": folder or null, "spared": …}``.
Starting processes takes longer than training tiny models, so several runs share them, and all
processes are forked from this one, which has imported everything, with the variables that torchrun
sets. The first rank prints a JSON list: for each job null, or the error that ended it. The last
line is the exit codes of both ranks for each JOBS.
"""

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


def rank(number: int, port: int, data: str, jobs: str) -> None:
    os.environ |= {"MASTER_PORT": str(port), "RANK": str(number), "LOCAL_RANK": str(number)}
    outcomes = [outcome(data, job) for job in json.loads(jobs)]
    if number == 0:
        print(json.dumps(outcomes), flush=True)


def main(data: str, *launches: str) -> None:
    catalog().add_plugin(TinyPlugin, "tiny_training_parts")
    context, codes = multiprocessing.get_context("fork"), []
    for jobs in launches:
        with socket.socket() as free:
            free.bind(("localhost", 0))
            port = free.getsockname()[1]
        ranks = [context.Process(target=rank, args=(n, port, data, jobs)) for n in (0, 1)]
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
