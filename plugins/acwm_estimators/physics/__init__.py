"""What the metrics of physics need to know of the environments.

The limits in ``limits.json`` are calibrated on true videos, by
``python -m acwm_metrics.calibrate``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib.resources import files

from acwm_core.estimator import Physics
from acwm_estimators.physics.deformable import cloth_move, push_rope
from acwm_estimators.physics.kinematics import reacher, robot_arm
from acwm_estimators.physics.particle import pour_water, push_sand
from acwm_estimators.physics.rigid import push_cube, stack_cube

Limits = Mapping[str, float]
"""Thresholds of one environment: relative ones by the name of a constant, in m by that of a gap
with ``.touch`` or ``.solid``, and in frames ``objects.lasting`` and ``objects.unseen``."""

WORLDS: Mapping[str, Callable[[Limits], Physics]] = {
    "push_cube": push_cube,
    "push_cube_4cube": push_cube,
    "push_cube_two_pushers": partial(push_cube, pushers=("pusher_1", "pusher_2")),
    "stack_cube": stack_cube,
    "push_rope": push_rope,
    "cloth_move": cloth_move,
    "cloth_move_8d": cloth_move,
    "push_sand": push_sand,
    "pour_water": pour_water,
    "robot_arm": robot_arm,
    "reacher": reacher,
}
"""Makes the physics of an environment from its limits."""

ALIKE = {
    "push_cube_4cube": "push_cube",
    "push_cube_two_pushers": "push_cube",
    "cloth_move_8d": "cloth_move",
}
"""Environments with the limits of another."""


@cache
def limits_of(environment: str) -> Limits:
    """The limits of an environment that are shipped."""
    shipped = files("acwm_estimators.physics").joinpath("limits.json").read_text()
    return json.loads(shipped)[ALIKE.get(environment, environment)]


@cache
def physics_of(environment: str) -> Physics:
    """What there is to measure in an environment, with the limits that are shipped."""
    return WORLDS[environment](limits_of(environment))


def limits_fingerprint(environment: str) -> str:
    """Hash of the limits of an environment."""
    text = json.dumps(limits_of(environment), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
