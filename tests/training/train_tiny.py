"""``python -m tests.training.train_tiny DATA RUN SECTIONS [RESUME]``: fit as the CLI would.

SECTIONS is JSON. Errors for users end it with their sentence and exit code.
"""

import json
import sys

from acwm_core.errors import AcwmError
from acwm_core.training.fit import fit
from tests.tiny import register, tiny_recipe


def main(data: str, run: str, sections: str, resume: str | None = None) -> None:
    register()
    try:
        fit(tiny_recipe(data, **json.loads(sections)), run, resume=resume)
    except AcwmError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main(*sys.argv[1:])
