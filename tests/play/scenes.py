"""Known scenes for the server of the tests, which would draw random ones."""

import itertools
from types import SimpleNamespace

FREE = (6, 17)
"""Episodes in which the pusher touches no cube wherever the tests send it.

In one of about forty scenes a cube between pusher and wall stops it on the way.
"""


def known():
    """In place of the module `secrets` of `acwm_play.simulator`: `FREE` in turn."""
    scenes = itertools.cycle(FREE)
    return SimpleNamespace(randbelow=lambda _: next(scenes))
