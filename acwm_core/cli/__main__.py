"""``python -m acwm_core.cli``: the same as ``acwm``; experiments run their steps this way."""

import os
import threading

from acwm_core.cli.main import main
from acwm_core.interrupts import begin_process

ENDS_WITH_INPUT = "ACWM_ENDS_WITH_INPUT"
"""Environment variable that makes a command end once its standard input is closed."""


def end_with_input() -> None:
    """Exit as soon as standard input closes, so that no step outlives a killed experiment."""
    while os.read(0, 1024):
        pass
    os._exit(1)


if __name__ == "__main__":
    if ENDS_WITH_INPUT in os.environ:
        threading.Thread(target=end_with_input, daemon=True).start()
    begin_process()
    main(prog_name="acwm")
