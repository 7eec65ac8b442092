"""What the model knows of a rope or a cloth: where its nodes are, and what pushes or holds it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from acwm_core.env.camera import Camera
from acwm_scene.poses import turned_back

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
        axes: coordinates of each place, 2 or 3.
        nodes: nodes along a rope, or along both sides of a cloth, as they were recorded.
        every: every n-th node along each side is kept, from the first on.
        unit: metres that count as one.

    Attributes:
        shape: number of nodes that are kept along each side.
    """

    def __init__(
        self, agents: int, axes: int, nodes: Sequence[int], every: int, unit: float
    ) -> None:
        self.agents, self.axes, self.every, self.unit = agents, axes, every, unit
        self.recorded = tuple(nodes)
        self.shape = tuple(-(-side // every) for side in nodes)

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
            first, second = (nodes.index_select(axis, rows) for rows in (below, above))
            share = (place - below).view(-1, *[1] * (nodes.ndim - axis - 1))
            nodes = torch.lerp(first, second, share.to(nodes))
        return self.unit * torch.cat([form.agents.flatten(2), nodes.flatten(2)], 2)


class View(nn.Module):
    """Where in the picture of the declared camera something is, in units of a group.

    Args:
        camera: of the environment's card.
        unit: metres that count as one.
    """

    axes: Tensor
    back: Tensor
    eye: Tensor

    def __init__(self, camera: Camera, unit: float) -> None:
        super().__init__()
        self.is_flat = camera.is_flat
        self.above = -1.0 if camera.eye[2] < 0 else 1.0  # a camera may look up at the plane
        scale = 2 * camera.scale * (unit if self.is_flat else 1.0)
        rows = torch.tensor(camera.axes) * torch.tensor([[scale], [scale], [1.0]]).double()
        self.register_buffer("axes", rows.float(), persistent=False)
        self.register_buffer("back", torch.linalg.inv(rows).float(), persistent=False)
        self.register_buffer("eye", torch.tensor(camera.eye).float() / unit, persistent=False)

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
        far = torch.ones_like(depth) if self.is_flat else depth
        return torch.stack([right / far / aspect, down / far, depth], -1)

    def places(self, seen: Tensor, aspect: float) -> Tensor:
        """The inverse: the places `[…, 3]` in units that are seen there, so far away."""
        right, down, depth = seen.unbind(-1)
        far = torch.ones_like(depth) if self.is_flat else depth
        ray = torch.stack([right * far * aspect, down * far, depth], -1)
        return (ray[..., None, :] * self.back).sum(-1) + self.eye

    def on_ground(self, spots: Tensor, aspect: float) -> Tensor:
        """The places `[…, 2]` on the plane z = 0 that are seen at spots `[…, 2]`."""
        near, far = (
            self.places(torch.cat([spots, torch.full_like(spots[..., :1], depth)], -1), aspect)
            for depth in (0.0, 1.0)
        )
        fall = (self.above * (near - far)[..., 2:]).clamp(min=HORIZON)
        return (near + self.above * near[..., 2:] / fall * (far - near))[..., :2]


def seen_at(grid: Tensor, spots: Tensor) -> Tensor:
    """What a grid `[B, C, h, w]` holds at places `[B, N, 2]`, right and down in −1 to 1."""
    spots = spots.clamp(-1.2, 1.2)[:, :, None]
    seen = nn.functional.grid_sample(grid, spots, padding_mode="border", align_corners=False)
    return seen[..., 0].transpose(1, 2)


def along_sides(nodes: Tensor, shape: tuple[int, ...]) -> Tensor:
    """What separates each node from its neighbours, `[B, N, 2 · sides · D]`; 0 beyond an edge."""
    neighbours: list[Tensor] = []
    grid = nodes.unflatten(1, shape)
    for side in range(1, len(shape) + 1):
        steps, none = grid.diff(dim=side), torch.zeros_like(grid.narrow(side, 0, 1))
        neighbours += [torch.cat([steps, none], side), torch.cat([none, -steps], side)]
    return torch.cat(neighbours, -1).flatten(1, len(shape))


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
        normed = self.norm(features)
        if len(shape) == 1 and not torch.is_grad_enabled():
            messages = self._heard_along(normed)
        else:
            grid = self.hear(normed.unflatten(1, shape).movedim(-1, 1))
            messages = grid.movedim(1, -1).flatten(1, len(shape))
        return features + self.mix(nn.functional.silu(messages))

    def _heard_along(self, line: Tensor) -> Tensor:
        """What `hear` makes of a line `[B, N, channels]`, as one product: 1.4 times as fast."""
        reach, weight = self.hear.dilation[0], self.hear.weight.permute(2, 0, 1)
        before, messages, after = nn.functional.linear(line, weight.flatten(0, 1)).chunk(3, -1)
        assert self.hear.bias is not None
        messages = messages + self.hear.bias
        messages[:, reach:] += before[:, :-reach]
        messages[:, :-reach] += after[:, reach:]
        return messages
