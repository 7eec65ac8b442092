"""What the model knows of agents and bodies: their poses on the plane."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError, ShapeError


class Poses(NamedTuple):
    """Agents and bodies in one video frame, or with an axis T after B in several.

    Lengths are in units of the model.

    Attributes:
        agents: places, `[B, A, 2]`.
        present: 1 for a body that is there and 0 for one that is not, `[B, N, 1]`; without T.
        places: of the bodies, `[B, N, 2]`.
        turns: cosine and sine of `folds` times the body's angle, `[B, N, 2]`.
    """

    agents: Tensor
    present: Tensor
    places: Tensor
    turns: Tensor


class Layout:
    """How the values of the state make poses.

    They are, side by side: the places of the agents (x, y), 1 or 0 for each body that is there or
    not, the places of the bodies (x, y and perhaps z, in metres) and their angles (rad).

    Args:
        agents: number of agents A.
        bodies: number of bodies N.
        folds: in how many ways a body can be turned and look the same; 4 for a cube.
        unit: metres that count as one.
        state_size: number of values; 0 if there are none to learn from.

    Raises:
        RecipeError: the values cannot be these.
    """

    def __init__(self, agents: int, bodies: int, folds: int, unit: float, state_size: int) -> None:
        self.agents, self.bodies, self.folds, self.unit = agents, bodies, folds, unit
        axes = (state_size - 2 * agents - 2 * bodies) / bodies
        if state_size and axes not in (2, 3):
            raise RecipeError(
                f"data.states has {state_size} values, which are not x and y of {agents} agents, "
                f"and presence, place and angle of {bodies} bodies: name these fields in this "
                "order, and set model.agents and model.bodies"
            )
        self.axes = int(axes)

    def poses(self, states: Tensor) -> Poses:
        """The poses in states `[B, T, S]`, as they were recorded."""
        batch, frames, _ = states.shape
        sizes = [2 * self.agents, self.bodies, self.axes * self.bodies, self.bodies]
        if states.shape[2] != sum(sizes):
            raise ShapeError(f"states have {states.shape[2]} values, not {sum(sizes)}")
        agents, present, places, angles = states.float().split(sizes, 2)
        places = places.reshape(batch, frames, self.bodies, self.axes)[..., :2]
        return Poses(
            agents.reshape(batch, frames, self.agents, 2) / self.unit,
            present[:, 0, :, None],
            places / self.unit,
            direction(self.folds * angles),
        )

    def states(self, poses: Poses) -> Tensor:
        """The states `[B, T, S]` of poses with an axis T; heights are NaN, as nothing tells them.

        Of angles that look the same, the one that is nearest to 0.
        """
        frames = poses.places.shape[1]
        present = poses.present[:, None, :, 0].expand(-1, frames, -1)
        places = self.unit * poses.places
        if self.axes == 3:
            places = functional.pad(places, (0, 1), value=math.nan)
        cosine, sine = poses.turns.unbind(-1)
        angles = torch.atan2(sine, cosine) / self.folds
        agents = self.unit * poses.agents
        return torch.cat([agents.flatten(2), present, places.flatten(2), angles], 2)


def direction(angle: Tensor) -> Tensor:
    """Cosine and sine of an angle, side by side in a last axis."""
    return torch.stack([angle.cos(), angle.sin()], -1)


def turned(vector: Tensor, by: Tensor) -> Tensor:
    """A vector `[…, 2]` turned by the angle whose cosine and sine are `by`, `[…, 2]`."""
    x, y = vector.unbind(-1)
    cos, sin = by.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def turned_back(vector: Tensor, by: Tensor) -> Tensor:
    """The inverse of `turned`: the vector as it is seen in a frame that is turned `by`."""
    return turned(vector, by * by.new_tensor([1.0, -1.0]))


def waves(values: Tensor, octaves: int) -> Tensor:
    """The values `[…, D]` and their Fourier features, `[…, D (1 + 2 octaves)]`.

    The longest wave has 8 units, and each further one half the length.
    """
    lengths = (math.pi / 4) * 2.0 ** torch.arange(octaves, device=values.device)
    angles = (values[..., None] * lengths).flatten(-2)
    return torch.cat([values, angles.sin(), angles.cos()], -1)


def waves_size(size: int, octaves: int) -> int:
    """Number of features that `waves` makes of `size` values."""
    return size * (1 + 2 * octaves)


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """The angle in rad from one direction `[…, 2]` to another, `[…, 1]`."""
    cosine, sine = turned_back(second, first).unbind(-1)
    return torch.atan2(sine, cosine)[..., None]


def history(poses: Poses, last: Tensor, frames: int) -> Poses:
    """The poses in the `frames` frames until each `last` one `[B, M]`, the last one first.

    `[B, M, frames, …]`; before the first frame, everything stands where it stands then.
    """
    numbers = last[..., None] - torch.arange(frames, device=last.device)
    numbers = numbers.clamp(min=0)
    rows = torch.arange(len(last), device=last.device)[:, None, None]
    agents, present, places, turns = poses
    present = present[:, None].expand(-1, last.shape[1], -1, -1)
    return Poses(agents[rows, numbers], present, places[rows, numbers], turns[rows, numbers])


def flattened(poses: Poses) -> Poses:
    """The first two axes as one."""
    return Poses(*(each.flatten(0, 1) for each in poses))


def concatenated(batches: Iterable[Poses]) -> Poses:
    """Several batches of poses as one."""
    return Poses(*(torch.cat(each) for each in zip(*batches, strict=True)))


def later(poses: Poses, first: int) -> Poses:
    """The poses from a frame on."""
    agents, present, places, turns = poses
    return Poses(agents[:, first:], present, places[:, first:], turns[:, first:])


def pose_at(poses: Poses, frame: int) -> Poses:
    """The poses in one frame of several."""
    agents, present, places, turns = poses
    return Poses(agents[:, frame], present, places[:, frame], turns[:, frame])


def stacked(frames: Sequence[Poses]) -> Poses:
    """Poses of several frames as one, `[B, T, …]`."""
    agents, _, places, turns = (list(each) for each in zip(*frames, strict=True))
    return Poses(
        torch.stack(agents, 1), frames[0].present, torch.stack(places, 1), torch.stack(turns, 1)
    )
