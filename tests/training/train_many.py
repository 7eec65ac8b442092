"""``python -m tests.training.train_many DATA JOBS``: one `fit` after another, in this process.

JOBS is a JSON list of ``{"run": folder, "sections": …, "resume": folder or null, "spared": …}``.
Starting processes takes longer than training tiny models, so several runs share them.
Prints a JSON list on the first rank: for each job null, or the error that ended it.
"""

import json
import os
import sys

from acwm_core.errors import AcwmError
from acwm_core.training.fit import fit
from tests.tiny import register, tiny_recipe


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


def main(data: str, jobs: str) -> None:
    register()
    outcomes = [outcome(data, job) for job in json.loads(jobs)]
    if os.environ.get("RANK", "0") == "0":
        print(json.dumps(outcomes))


if __name__ == "__main__":
    main(*sys.argv[1:])
