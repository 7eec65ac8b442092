"""`import acwm` puts every installed environment into Gymnasium's registry.

    import acwm, gymnasium
    env = gymnasium.make("acwm/push_cube-v0")

Or in one line, `gymnasium.make("acwm:acwm/push_cube-v0")`. Everything else lives in `acwm_core`.
"""

import acwm_core.gymnasium_ids as gymnasium_ids
from acwm_core import __version__

__all__ = ["__version__", "gymnasium_ids"]
