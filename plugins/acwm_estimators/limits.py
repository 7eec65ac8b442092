"""An environment's physics, with thresholds above the errors of its estimator.

The limits in ``limits.json`` are calibrated on true videos, by
``python -m acwm_metrics.calibrate``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.resources import files

from acwm_core.env.physics import Gap, Physics
from acwm_core.plugins import catalog
from acwm_estimators.plugin import WEIGHTS

Limits = Mapping[str, float]
"""Thresholds of one estimator: relative ones by the name of a constant; in m by the name of a gap
with ``.touch`` or ``.solid``; and in frames, ``objects.lasting`` and ``objects.unseen``."""


@cache
def limits_of(environment: str) -> Limits:
    """The shipped limits of an environment's estimator."""
    shipped = json.loads(files("acwm_estimators").joinpath("limits.json").read_text("utf-8"))
    return shipped[WEIGHTS[environment]]


def limits_fingerprint(environment: str) -> str:
    """Hash of the limits of an environment."""
    text = json.dumps(limits_of(environment), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def ideal_physics_of(environment: str) -> Physics:
    """What can be measured in an environment, from its package; needs no simulator."""
    return catalog().component("environment", environment).load_physics()


@cache
def physics_of(environment: str) -> Physics:
    """What can be measured in an environment, with the shipped limits."""
    return with_limits(ideal_physics_of(environment), limits_of(environment))


def with_limits(physics: Physics, limits: Limits) -> Physics:
    """Physics with the thresholds replaced by these limits."""
    return replace(
        physics,
        constants=tuple(replace(each, tolerance=limits[each.name]) for each in physics.constants),
        gaps=tuple(_limited(gap, limits) for gap in physics.gaps),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
    )


def _limited(gap: Gap, limits: Limits) -> Gap:
    touch = None if gap.touch is None else limits[f"{gap.name}.touch"]
    solid = None if gap.solid is None else limits[f"{gap.name}.solid"]
    return replace(gap, touch=touch, solid=solid)
