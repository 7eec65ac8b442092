"""`RewardHead`: a small network from states or latents to a recorded reward, in a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from acwm_core.data.shards import file_sha256
from acwm_core.env.card import EnvironmentCard
from acwm_core.env.state_field import StateField
from acwm_core.env.states import code_size, encode
from acwm_core.errors import DataError, RecipeError
from acwm_planning.policies.saved import FURTHEST, read_network, save_network
from acwm_planning.rewards import HEAD_FILE


@dataclass(frozen=True)
class HeldOut:
    """The error of a head on episodes that it did not learn from.

    Attributes:
        episodes: number of episodes.
        frames: number of frames.
        error: root of the mean squared error, in the unit of the reward.
        share: mean squared error, relative to that of always predicting the mean reward.
        low: lower end of the 95 % interval of `share` over episodes; None with fewer than five.
        high: its upper end.
    """

    episodes: int
    frames: int
    error: float
    share: float
    low: float | None
    high: float | None

    @property
    def text(self) -> str:
        """The relative error in words."""
        known = self.low is not None and self.high is not None
        about = f" [{self.low:.2f}, {self.high:.2f}]" if known else ""
        count = f"{self.episodes} held-out episode{'' if self.episodes == 1 else 's'}"
        return f"{self.share:.2f}{about} of the error of the mean reward on {count}"


@dataclass(frozen=True)
class RewardCard:
    """What a head predicts, from what, and how well.

    Attributes:
        environment: name of the environment.
        column: name of the recorded column.
        ahead: the reward of a row belongs to the frame so many frames later, 0 or 1.
        two_valued: whether the column has two values, as a success.
        best: the highest recorded reward.
        worst: the lowest.
        mean: mean of the rewards.
        std: their standard deviation.
        state: fields of the state that the head looks at; none for a head on latents.
        latent: shape `[C, h, w]` of a latent frame that it looks at; empty for a head on states.
        latents: name of these latents (`Codec.latents_fingerprint`).
        input_mean: means of what it looks at, `[E]`: codes of the fields, or numbers of latents.
        input_std: their standard deviations.
        layers: the network; see `acwm_planning.policies.saved.PolicyCard`.
        held_out: its error.
        training: how it was trained, for people.
    """

    environment: str
    column: str
    ahead: int
    two_valued: bool
    best: float
    worst: float
    mean: float
    std: float
    state: tuple[StateField, ...]
    latent: tuple[int, ...]
    latents: str
    input_mean: list[float]
    input_std: list[float]
    layers: list[int | str]
    held_out: HeldOut
    training: dict[str, Any]

    @property
    def tolerance(self) -> float:
        """How far below the best reward counts as reached: what the head cannot tell apart.

        Half the range of a column of two values, else the error on held-out episodes.
        """
        return (self.best - self.worst) / 2 if self.two_valued else self.held_out.error


class RewardHead:
    """A reward of states or of latents, as `acwm train-reward` leaves it.

    Args:
        card: what it predicts, from what.
        network: maps scaled inputs `[N, E]` to scaled rewards `[N, 1]`.
    """

    def __init__(self, card: RewardCard, network: nn.Module) -> None:
        self.card, self.network = card, network.double().eval().requires_grad_(False)

    def check(self, card: EnvironmentCard) -> None:
        """Refuse another environment.

        Raises:
            RecipeError: it is another, or has not the fields that the head looks at.
        """
        mine, fields = self.card, card.fields
        if mine.environment != card.name:
            raise RecipeError(f"the reward is of {mine.environment}, not of {card.name}")
        for field in mine.state:
            if field.name not in fields or fields[field.name].shape != field.shape:
                raise RecipeError(
                    f"the reward looks at {field.name} {[*field.shape]}, which this {card.name} "
                    "does not have"
                )

    def of_states(self, fields: Mapping[str, Any]) -> Tensor:
        """Rewards `[N]` of states, by name `[N, …]`; NaN where one of them is unknown."""
        return self.of_inputs(codes_of(fields, self.card.state))

    def of_latents(self, latents: Tensor) -> Tensor:
        """Rewards `[N]` of latent frames `[N, C, h, w]`.

        Raises:
            DataError: they have another shape.
        """
        if tuple(latents.shape[1:]) != self.card.latent:
            raise DataError(
                f"the reward is of latents {list(self.card.latent)}, not {list(latents.shape[1:])}"
            )
        return self.of_inputs(latents.flatten(1))

    def of_inputs(self, inputs: Tensor) -> Tensor:
        """Rewards `[N]` of codes of states, or numbers of latents, `[N, E]`."""
        inputs = inputs.double().cpu()
        return (
            self.network(scaled(inputs, self.card.input_mean, self.card.input_std))[:, 0].where(
                inputs.isfinite().all(1), math.nan
            )
            * self.card.std
            + self.card.mean
        )

    def save(self, folder: Path) -> None:
        """Write the head's file into a folder."""
        save_network(folder / HEAD_FILE, self.network, reward_head=self.card)

    @classmethod
    def read(cls, folder: str | Path) -> RewardHead:
        """The head of a folder.

        Raises:
            DataError: there is none, or the file is damaged or of another version.
        """
        path = Path(folder) / HEAD_FILE
        if not path.is_file():
            raise DataError(f"{folder} holds no reward head: train one with `acwm train-reward`")
        return cls(*read_network(path, "reward_head", RewardCard, _check_sizes))


def digest_of(folder: str | Path) -> str:
    """SHA-256 of a head's file, in hex digits."""
    return file_sha256(Path(folder) / HEAD_FILE)


def codes_of(fields: Mapping[str, Any], state: tuple[StateField, ...]) -> Tensor:
    """Codes `[N, E]` of states, by name `[N, …]`, in which what looks alike is alike."""
    parts = [
        encode(field, torch.as_tensor(fields[field.name]).double().reshape(-1, *field.shape))
        for field in state
    ]
    return torch.cat([torch.as_tensor(part).flatten(1) for part in parts], 1)


def scaled(inputs: Tensor, mean: list[float], std: list[float]) -> Tensor:
    """Inputs `[N, E]` as the network takes them; what is unknown is 0."""
    values = (inputs - inputs.new_tensor(mean)) / inputs.new_tensor(std)
    return values.nan_to_num(0.0).clamp(-FURTHEST, FURTHEST)


def _check_sizes(card: RewardCard, network: nn.Sequential) -> None:
    """Refuse a network that does not fit what it looks at, by `ValueError`."""
    size = sum(code_size(field) * field.rows for field in card.state) or math.prod(card.latent)
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    ends = (linear[0].in_features, linear[-1].out_features) if linear else (0, 0)
    if ends != (size, 1) or len(card.input_mean) != size or len(card.input_std) != size:
        raise ValueError("its sizes do not fit each other")
