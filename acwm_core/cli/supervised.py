"""``python -m acwm_core.cli.supervised``: ``acwm`` that ends as soon as its standard input does.

An experiment holds the other end of that pipe, so that nothing of it goes on after it was killed.
"""

import os
import threading

from acwm_core.cli.main import main


def end_with_input() -> None:
    """End this process at once when its standard input ends, which may be in a thread."""
    while os.read(0, 1024):
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=end_with_input, daemon=True).start()
    main(prog_name="acwm")
