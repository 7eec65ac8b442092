"""What the model knows of a rope or a cloth: where its nodes are, and what pushes or holds it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_recurrent.poses import turned_back

EVEN = 2
"""How often nodes are put at equal distances; each time the line gets a little shorter."""

PULLS, PULL = 4, 0.25
"""How often neighbours that are too far apart pull at each other; the share of the excess."""

HORIZON = 1e-2
"""How far below the horizon the ground is seen at least, in units a unit away."""


class Form(NamedTuple):
    """Agents and nodes in one video frame, or with an axis T after B in several.

    Attributes:
        agents: places in units, `[B, A, D]`.
        nodes: places in units, row by row, `[B, N, D]`.
    """

    agents: Tensor
    nodes: Tensor

    def at(self, frame: int) -> Form:
        """In one frame of several."""
        return Form(self.agents[:, frame], self.nodes[:, frame])

    def since(self, first: int) -> Form:
        """From a frame on."""
        return Form(self.agents[:, first:], self.nodes[:, first:])

    def reversed(self, which: Tensor) -> Form:
        """Those for which `which`, `[B]`, is true with their nodes in the opposite order."""
        which = which.view(-1, *[1] * (self.nodes.ndim - 1))
        return Form(self.agents, torch.where(which, self.nodes.flip(-2), self.nodes))


class NodeLayout:
    """How the values of the state make a form.

    They are the places of the agents, then those of all nodes, row by row: x and y, or x, y and z,
    in metres.

    Args:
        agents: number of agents A.
        nodes: nodes along a rope, or along both sides of a cloth, as they were recorded.
        every: of which every so many-th along each side are kept, from the first one on.
        unit: metres that count as one.
        state_size: number of values; 0 if there are none to learn from.

    Attributes:
        shape: number of nodes that are kept along each side.
        axes: 2 or 3.

    Raises:
        RecipeError: the values cannot be these.
    """

    def __init__(
        self, agents: int, nodes: Sequence[int], every: int, unit: float, state_size: int
    ) -> None:
        if len(nodes) not in (1, 2) or min(*nodes, agents, every, 1) < 1 or unit <= 0:
            raise RecipeError(
                "model.nodes is the number of nodes along a rope or along both sides of a cloth, "
                f"as in [80] or [21,21], and not {list(nodes)}; agents, every and unit are positive"
            )
        self.agents, self.every, self.unit = agents, every, unit
        self.recorded = tuple(nodes)
        self.shape = tuple(-(-side // every) for side in nodes)
        axes = state_size / (agents + math.prod(nodes))
        if state_size and axes not in (2, 3):
            raise RecipeError(
                f"data.states has {state_size} values, which are not x and y, or x, y and z, of "
                f"{agents} agents and {math.prod(nodes)} nodes: name these fields in this order, "
                "and set model.agents and model.nodes"
            )
        self.axes = int(axes) or 2

    @property
    def facing_size(self) -> int:
        """Number of values that `facing` tells of each node; 0 of a rope, or in the plane."""
        return 4 if len(self.shape) == 2 and self.axes == 3 else 0

    @property
    def reversible(self) -> bool:
        """Whether the nodes may be counted from either end, which look alike."""
        return len(self.shape) == 1

    def form(self, states: Tensor) -> Form:
        """The form in states `[B, T, S]`, as they were recorded."""
        sizes = [self.agents * self.axes, math.prod(self.recorded) * self.axes]
        if states.shape[2] != sum(sizes):
            raise ShapeError(f"states have {states.shape[2]} values, not {sum(sizes)}")
        agents, nodes = (states.float() / self.unit).split(sizes, 2)
        nodes = nodes.unflatten(2, (*self.recorded, self.axes))
        for axis in range(len(self.recorded)):
            kept = torch.arange(0, self.recorded[axis], self.every, device=nodes.device)
            nodes = nodes.index_select(2 + axis, kept)
        return Form(agents.unflatten(2, (self.agents, self.axes)), nodes.flatten(2, -2))

    def states(self, form: Form) -> Tensor:
        """The states `[B, T, S]` of a form with an axis T; other nodes are on straight lines."""
        nodes = form.nodes.unflatten(2, self.shape)
        for axis, (side, kept) in enumerate(zip(self.recorded, self.shape, strict=True), 2):
            place = torch.arange(side, device=nodes.device) / self.every
            below = place.long().clamp(max=max(kept - 2, 0))
            above = (below + 1).clamp(max=kept - 1)
            first, second = (nodes.index_select(axis, each) for each in (below, above))
            share = (place - below).view(-1, *[1] * (nodes.ndim - axis - 1))
            nodes = torch.lerp(first, second, share.to(nodes))
        return self.unit * torch.cat([form.agents.flatten(2), nodes.flatten(2)], 2)


class View(nn.Module):
    """A camera that stands still: where in the picture something is.

    Args:
        eye: where it stands, metres.
        target: what it looks at, metres.
        fov: vertical field of view, degrees.
        unit: metres that count as one.
    """

    axes: Tensor
    back: Tensor
    eye: Tensor

    def __init__(
        self, eye: Sequence[float], target: Sequence[float], fov: float, unit: float
    ) -> None:
        super().__init__()
        away = torch.tensor(target, dtype=torch.float64) - torch.tensor(eye, dtype=torch.float64)
        if away.shape != (3,) or not away.norm() > 0 or not 0 < fov < 180:
            raise RecipeError(
                "model.eye and model.target are two different places [x, y, z] in metres, and "
                "model.fov is an angle below 180 degrees"
            )
        forward = away / away.norm()
        up = torch.tensor([0.0, 0.0, 1.0] if forward[2].abs() < 0.999 else [0.0, 1.0, 0.0])
        right = torch.linalg.cross(forward, up.double())
        right = right / right.norm()
        rows = torch.stack([right, torch.linalg.cross(forward, right), forward])
        scale = 1 / math.tan(math.radians(fov) / 2)
        rows = rows * torch.tensor([[scale], [scale], [1.0]], dtype=torch.float64)
        self.register_buffer("axes", rows.float(), persistent=False)
        self.register_buffer("back", torch.linalg.inv(rows).float(), persistent=False)
        self.register_buffer("eye", torch.tensor(eye).float() / unit, persistent=False)

    def forward(self, places: Tensor, aspect: float) -> Tensor:
        """Where places `[…, 2 or 3]` in units are: right, down in −1 to 1, and depth in units.

        Args:
            places: with x and y alone they are on the plane z = 0.
            aspect: width of the picture by its height.
        """
        if places.shape[-1] == 2:
            places = torch.cat([places, torch.zeros_like(places[..., :1])], -1)
        # Not a matrix product, which mixed precision would round.
        right, down, depth = ((places - self.eye)[..., None, :] * self.axes).sum(-1).unbind(-1)
        depth = depth.clamp(min=1e-3)
        return torch.stack([right / depth / aspect, down / depth, depth], -1)

    def places(self, seen: Tensor, aspect: float) -> Tensor:
        """The inverse: the places `[…, 3]` in units that are seen there, so far away."""
        right, down, depth = seen.unbind(-1)
        ray = torch.stack([right * depth * aspect, down * depth, depth], -1)
        return (ray[..., None, :] * self.back).sum(-1) + self.eye

    def on_ground(self, spots: Tensor, aspect: float) -> Tensor:
        """The places `[…, 2]` on the plane z = 0 that are seen at spots `[…, 2]`."""
        seen = torch.cat([spots, torch.ones_like(spots[..., :1])], -1)
        ray = self.places(seen, aspect) - self.eye
        far = -self.eye[2] / ray[..., 2:].clamp(max=-HORIZON)
        return (self.eye + far * ray)[..., :2]


def seen_at(grid: Tensor, spots: Tensor) -> Tensor:
    """What a grid `[B, C, h, w]` holds at places `[B, N, 2]`, right and down in −1 to 1."""
    spots = spots.clamp(-1.2, 1.2)[:, :, None]
    seen = nn.functional.grid_sample(grid, spots, padding_mode="border", align_corners=False)
    return seen[..., 0].transpose(1, 2)


def along_sides(nodes: Tensor, shape: tuple[int, ...]) -> Tensor:
    """What separates each node from its neighbours, `[B, N, 2 · sides · D]`; 0 beyond an edge."""
    grid, found = nodes.unflatten(1, shape), list[Tensor]()
    for side in range(1, len(shape) + 1):
        steps, none = grid.diff(dim=side), torch.zeros_like(grid.narrow(side, 0, 1))
        found += [torch.cat([steps, none], side), torch.cat([none, -steps], side)]
    return torch.cat(found, -1).flatten(1, len(shape))


def facing(nodes: Tensor, sides: Tensor, eye: Tensor) -> Tensor:
    """How a cloth faces the camera at each node, `[B, N, 4]`.

    Args:
        nodes: places in units, `[B, N, 3]`.
        sides: what `along_sides` makes of them.
        eye: where the camera stands, in units.

    Returns:
        The unit normal, and its part along the line of sight.
    """
    after, before = sides.unflatten(2, (2, 2, -1)).unbind(3)
    down, across = (after - before).unbind(2)
    normal = nn.functional.normalize(torch.linalg.cross(across, down), dim=-1, eps=1e-4)
    sight = nn.functional.normalize(nodes - eye, dim=-1)
    return torch.cat([normal, (normal * sight).sum(-1, keepdim=True)], -1)


def ahead_of(agents: Tensor) -> Tensor:
    """The horizontal direction from the first agent to the second one, `[B, 1, 2]`."""
    return nn.functional.normalize(agents[:, 1:2, :2] - agents[:, :1, :2], dim=-1, eps=1e-6)


def seen_from(ahead: Tensor, places: Tensor) -> Tensor:
    """Places `[B, N, D]` where `ahead` is along x."""
    return torch.cat([turned_back(places[..., :2], ahead), places[..., 2:]], -1)


def evenly(nodes: Tensor) -> Tensor:
    """A line of nodes `[B, N, D]`, with these at equal distances along it."""
    share = torch.linspace(0, 1, nodes.shape[1], device=nodes.device)
    for _ in range(EVEN):
        steps = nodes.diff(dim=1)
        far = steps.norm(dim=-1).clamp(min=1e-6)
        after = far.cumsum(1)
        wanted = share * after[:, -1:]
        step = (wanted[:, :, None] > after[:, None, :-1]).sum(-1)
        part = (wanted - (after - far).gather(1, step)) / far.gather(1, step)
        step = step[..., None].expand(-1, -1, nodes.shape[2])
        nodes = nodes[:, :-1].gather(1, step) + part[..., None] * steps.gather(1, step)
    return nodes


def spacing(nodes: Tensor, shape: tuple[int, ...]) -> Tensor:
    """How far apart neighbours are along the side of a rope or cloth that is straightest, `[B]`."""
    grid = nodes.unflatten(1, shape)
    sides = [grid.diff(dim=side + 1).norm(dim=-1).flatten(1).mean(1) for side in range(len(shape))]
    return torch.stack(sides).amax(0)


def unstretched(nodes: Tensor, shape: tuple[int, ...], longest: Tensor) -> Tensor:
    """Nodes `[B, N, D]`, with neighbours pulled together that are further apart than `longest`.

    Position based dynamics (Müller et al. 2007), all neighbours at a time.
    """
    grid, longest = nodes.unflatten(1, shape), longest.view(-1, *[1] * (len(shape) + 1))
    for _ in range(PULLS):
        for side in range(1, len(shape) + 1):
            apart = grid.diff(dim=side)
            far = apart.norm(dim=-1, keepdim=True).clamp(min=1e-6)
            pull = PULL * (1 - longest / far).clamp(min=0) * apart
            none = torch.zeros_like(pull.narrow(side, 0, 1))
            grid = grid + torch.cat([pull, none], side) - torch.cat([none, pull], side)
    return grid.flatten(1, len(shape))


class NodeBlock(nn.Module):
    """A residual block that lets nodes hear of others along the rope or across the cloth.

    Args:
        sides: 1 for a rope, 2 for a cloth.
        channels: of each node.
        reach: how many nodes away the neighbours are that it hears of.
    """

    def __init__(self, sides: int, channels: int, reach: int) -> None:
        super().__init__()
        kind = (nn.Conv1d, nn.Conv2d)[sides - 1]
        self.norm = nn.LayerNorm(channels)
        self.hear = kind(channels, channels, 3, padding=reach, dilation=reach)
        self.mix = nn.Linear(channels, channels)

    def forward(self, features: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Map features `[B, N, channels]` to features."""
        grid = self.norm(features).unflatten(1, shape).movedim(-1, 1)
        heard = nn.functional.silu(self.hear(grid)).movedim(1, -1).flatten(1, len(shape))
        return features + self.mix(heard)
