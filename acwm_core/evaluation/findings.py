"""What only the simulator can tell, as it stands in ``summary.json``."""

from __future__ import annotations

from dataclasses import dataclass

from acwm_core.evaluation.estimates import Estimate


@dataclass(frozen=True)
class ResponseCurve:
    """How strongly the video answers a change of one dimension of the action.

    Attributes:
        dimension: its name.
        unit: its unit.
        size: what was asked for: a shift by this share of half the dimension's range, throughout.
        shift: mean change that was left of it within the bounds, in the unit.
        truth: per frame the true response: root mean square difference over pixels and channels of
            values in [0, 1] between the simulated branch and the simulated factual clip.
        rows: by row and frame the part of the predicted response that is the true one, in the same
            unit: equal to `truth` is right, 0 is deaf, negative is the wrong way. None where there
            is no true response.
    """

    dimension: str
    unit: str
    size: float
    shift: float
    truth: list[float]
    rows: dict[str, list[float | None]]


@dataclass(frozen=True)
class Counterfactual:
    """How rightly rows answer other actions from the same first frame.

    For each row, all its branches pooled, the predicted response is ``gain`` times the true one and
    a rest that has nothing to do with it, whose energy relative to the true response's is
    ``stray``. The metric `response` is 1 − (1 − gain)² − stray.

    Attributes:
        clips: how many.
        frames: length of each.
        branches: other action sequences of all clips together.
        rows: by row and metric, over all branches.
        kinds: the same by kind of branch: ``another`` (another episode's actions), ``still``,
            ``reversed`` (in time), ``mirrored``, and each action dimension by its name.
        gain: by kind of branch, and ``all``, by row; 1 is right.
        stray: likewise; 0 is right.
        curves: by action dimension and size.
    """

    clips: int
    frames: int
    branches: int
    rows: dict[str, dict[str, Estimate]]
    kinds: dict[str, dict[str, dict[str, Estimate]]]
    gain: dict[str, dict[str, float | None]]
    stray: dict[str, dict[str, float | None]]
    curves: list[ResponseCurve]


@dataclass(frozen=True)
class Predictability:
    """How long the environment itself can be foreseen.

    The simulator starts a millimetre off (see `Environment._perturb`) and takes the same actions.

    Attributes:
        clips: how many.
        share: per frame the mean squared error of that simulation, as a share of what the first
            frame, standing still, has; None where nothing has moved.
        horizon: the frame from which on the share stays at or above `limit`: scores of later
            frames tell nothing of a model. None if it is below at the end.
        limit: the share that counts as unforeseeable.
    """

    clips: int
    share: list[float | None]
    horizon: int | None
    limit: float
