"""Prints a digest of each world's frames, masks and states for a seed and some actions."""

import hashlib
import sys

import numpy as np

from acwm_core.data.simulate import make_environment

for world in sys.argv[1:]:
    environment = make_environment(world, {"size": (64, 64)})
    generator = np.random.default_rng(0)
    digest = hashlib.sha256()
    frame, info = environment.reset(seed=3)
    for _ in range(4):
        for array in (frame, info["mask"], *info["state"].values()):
            digest.update(np.ascontiguousarray(array).tobytes())
        space = environment.action_space
        action = generator.uniform(space.low, space.high).astype(np.float32)
        frame, _, _, _, info = environment.step(action)
    environment.close()
    print(world, digest.hexdigest())
