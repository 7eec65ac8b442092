"""The shell's variables do not reach the simulators: equal bytes in every shell."""

import contextlib
import os
import warnings
from collections.abc import Generator


@contextlib.contextmanager
def undisturbed(*prefixes: str, **settings: str) -> Generator[None]:
    """Within the block, hide environment variables and let no warning become an error.

    Args:
        *prefixes: how the names of hidden variables begin.
        **settings: variables to set instead; their names begin like that, too.
    """
    hidden = {name: os.environ.pop(name) for name in [*os.environ] if name.startswith(prefixes)}
    os.environ.update(settings)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PYTHONWARNINGS=error
            yield
    finally:
        for name in settings:
            os.environ.pop(name, None)
        os.environ.update(hidden)
