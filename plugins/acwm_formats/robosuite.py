"""What robosuite's settings say about the actions in a file: their rate, and what they command."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple, cast

from acwm_core.env.card import ActionKind

STEPS = ("OSC_", "IK_", "JOINT_POSITION")
"""Controllers that take steps unless their settings say otherwise."""

MOTORS: dict[str, ActionKind] = {"JOINT_VELOCITY": "velocity", "JOINT_TORQUE": "torque"}

SIZES = {"OSC_POSE": 6, "OSC_POSITION": 3, "IK_POSE": 6}
"""Numbers of actions of controllers; those of joints have one for each of the arm's."""

JOINTS = 7  # of the arms that robosuite's datasets are of

TOOLS = ("gripper", "GRIP")
"""Names of parts that hold something: their command is held in every case."""

UNMOVED = ("torso", "base", "head", "legs")
"""Parts that stay where they are in recordings of arms."""


class Control(NamedTuple):
    """How a robot was controlled.

    Attributes:
        rate: actions per second; None if it is not known.
        kind: what they command; None if it is not known.
        arm: number of actions of the only arm, which those of its gripper follow; 0 if there are
            several arms, or it is not known.
    """

    rate: Fraction | None = None
    kind: ActionKind | None = None
    arm: int = 0


def robosuite(env_args: Any) -> Control:
    """What the JSON of `env_args` says about the actions.

    Up to 1.4 a controller's ``control_delta`` says whether it takes steps; from 1.5 on, the
    ``input_type`` of each of the ``body_parts`` does. Without either, controllers of poses and of
    joint positions take steps (robosuite.controllers), and so does the default controller.
    """
    try:
        settings = json.loads(env_args)["env_kwargs"]
    except (TypeError, ValueError, KeyError):
        return Control()
    if not isinstance(settings, dict):
        return Control()
    known = cast(dict[str, Any], settings)
    try:
        rate = Fraction(known["control_freq"]).limit_denominator(10**6)
        rate = rate if rate > 0 else None
    except (KeyError, TypeError, ValueError, OverflowError):
        rate = None
    given = known.get("controller_configs")
    if given is None:
        given = {} if "robots" in known or "control_freq" in known else {"type": ""}
    parts = list(_parts(given))
    kinds: set[ActionKind | None] = {_of_part(part) for part in parts}
    arm = _size(parts[0]) if len(parts) == 1 else 0
    return Control(rate, kinds.pop() if len(kinds) == 1 else None, arm)


def _size(part: Mapping[str, Any]) -> int:
    kind = str(part.get("type", "OSC_POSE"))
    return SIZES.get(kind, JOINTS if kind.startswith("JOINT_") else 0)


def _parts(given: Any) -> Iterator[Mapping[str, Any]]:
    """The controllers of all arms, in any version: one, a list, or the parts of a body."""
    if isinstance(given, list):
        for part in cast(list[Any], given):
            yield from _parts(part)
    elif isinstance(given, dict):
        config = cast(dict[str, Any], given)
        bodies = config.get("body_parts", config.get("body_parts_controller_configs"))
        if not isinstance(bodies, dict):
            yield config
            return
        parts = cast(dict[str, Any], bodies)
        nested = parts.get("arms")
        arms = cast(dict[str, Any], nested) if isinstance(nested, dict) else parts
        for name, part in arms.items():
            if isinstance(part, dict) and not name.startswith((*TOOLS, *UNMOVED)):
                yield cast(dict[str, Any], part)
    else:
        yield {"type": ""}


def _of_part(part: Mapping[str, Any]) -> ActionKind | None:
    kind = str(part.get("type", "OSC_POSE"))
    if kind in MOTORS:
        return MOTORS[kind]
    if not kind.startswith(STEPS):
        return None
    relative = part.get("control_delta", True) is not False
    said = str(part.get("input_type", "delta" if relative else "absolute"))
    known: dict[str, ActionKind] = {"delta": "delta", "absolute": "absolute"}
    return known.get(said)
