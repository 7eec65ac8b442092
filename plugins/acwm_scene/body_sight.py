"""Reads poses from a latent frame."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.layers import Look
from acwm_scene.poses import Poses

LEAST = 0.02
"""Distance, in units, below which a pose counts as nearly right in `pose_distance`."""


class BodySight(Look):
    """Finds every agent and body by where it looks: a softmax over the cells, one for each thing.

    Which body is which, it tells by the look: number k has the same colour in all episodes.

    Args:
        latent_channels: channels C of the latent.
        agents: number of agents.
        bodies: number of bodies.
        channels: channels of its convolutions.
    """

    def __init__(self, latent_channels: int, agents: int, bodies: int, channels: int) -> None:
        super().__init__(latent_channels, channels)
        self.agents, self.things = agents, agents + bodies
        self.where = nn.Conv2d(channels, self.things, 1)
        self.what = nn.Conv2d(channels, 4 * self.things, 1)
        self.there = nn.Linear(channels, bodies)

    def forward(self, frame: Tensor, cells: Tensor) -> tuple[Poses, Tensor]:
        """Poses in a latent frame `[B, C, h, w]`, whose cells are at `[h w, 2]`.

        Returns:
            The poses, and `[B, N]`, the logits of a body's presence.
        """
        grid = self.features(frame)
        looks = self.where(grid).flatten(2).float().softmax(-1)
        seen = self.what(grid).unflatten(1, (self.things, 4)).flatten(3).float()
        located = (seen * looks[:, :, None]).sum(-1)
        places = looks @ cells + located[..., :2]
        turns = functional.normalize(located[:, self.agents :, 2:], dim=-1)
        logits = self.there(grid.flatten(2).amax(-1)).float()
        present = logits.sigmoid()[..., None]
        present = present + (present.round() - present).detach()  # 0 or 1, with a gradient
        return Poses(places[:, : self.agents], present, places[:, self.agents :], turns), logits


def sight_loss(seen: Poses, logits: Tensor, true: Poses) -> Tensor:
    """The error of what was seen, a scalar; of bodies that are absent, of their presence alone."""
    agents = functional.smooth_l1_loss(seen.agents, true.agents, beta=0.05)
    presence = functional.binary_cross_entropy_with_logits(logits, true.present[..., 0])
    return agents + pose_loss(seen, true) + presence


def pose_loss(predicted: Poses, true: Poses) -> Tensor:
    """The error of the poses of the bodies that are there, a scalar.

    Places count by their distance and not its square: the few that are far off, because a push was
    missed or something is hidden, would outweigh all others.
    """
    places = functional.smooth_l1_loss(predicted.places, true.places, beta=0.05, reduction="none")
    turns = functional.smooth_l1_loss(predicted.turns, true.turns, beta=0.1, reduction="none")
    return ((places + 0.2 * turns) * true.present).sum() / true.present.sum().clamp(min=1)


def pose_distance(first: Poses, second: Poses) -> Tensor:
    """The mean distance of the poses of the bodies that are there, a scalar.

    Of each body a multiquadric of place and turn together, which is as good for an energy score as
    the Euclidean norm and has a gradient at zero.
    """
    places = (first.places - second.places).square().sum(-1)
    turns = (0.2 * (first.turns - second.turns)).square().sum(-1)
    there = second.present[..., 0]
    distance = (places + turns + LEAST**2).sqrt() - LEAST
    return (distance * there).sum() / there.sum().clamp(min=1)
