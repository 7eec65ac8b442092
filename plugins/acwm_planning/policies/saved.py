"""`SavedPolicy`: a policy in a file that holds weights and plain values, and runs no code."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal
from acwm_core.errors import DataError, RecipeError
from acwm_core.files import check_fetched, parse_json, typed, written_whole
from acwm_planning.policies.networks import network_of

POLICY_FILE = "policy.safetensors"
"""The file in a policy's folder."""

FURTHEST = 10.0
"""Scaled observations are limited to ± this number, so that no outlier upsets a network."""

MOST_SIDE = 1024
"""Longest side of a picture that a policy may observe, in pixels."""


@dataclass(frozen=True)
class PolicyInputs:
    """What a policy observes, as one vector.

    The state now, its change since the decision before, and the goal: fields side by side, scaled.
    What is unknown is taken as the mean. Or the same of pictures: the frame now, its change, and
    the goal's picture.

    Attributes:
        state: shapes of the fields of the state, by name.
        goal: shapes of the fields of the goal's state.
        mean: of the fields of the state and of the goal, `[S + G]`.
        std: their standard deviations.
        change: standard deviation of the changes of the state, `[S]`. Of pictures, `mean` is the
            mean one, `[3 · h · w]` from 0 to 255, and `std` and `change` hold one number each.
        picture: height and width of the pictures; empty if states are observed.
        aims: whether a picture of the goal is observed.
    """

    state: dict[str, list[int]]
    goal: dict[str, list[int]]
    mean: list[float]
    std: list[float]
    change: list[float]
    picture: list[int] = field(default_factory=list[int])
    aims: bool = False

    @property
    def channels(self) -> int:
        """Number of channels of the pictures."""
        return 3 * (2 + self.aims)

    @property
    def size(self) -> int:
        """Number of values of the vector."""
        if self.picture:
            return self.channels * math.prod(self.picture)
        return len(self.mean) + len(self.change)

    def vectors(self, now: Tensor, before: Tensor, goals: Tensor) -> Tensor:
        """The vectors `[N, size]` of states `[N, S]`, earlier ones, and goals `[N, G]`.

        Pictures are rows of `small_pictures`.
        """
        if self.picture:
            mean, (std,), (change,) = torch.tensor(self.mean), self.std, self.change
            pictures = [(now - mean) / std, (now.float() - before) / change]
            return torch.cat([*pictures, *([(goals - mean) / std] if self.aims else [])], 1)
        mean, std, change = (
            torch.tensor(row, dtype=torch.float64) for row in (self.mean, self.std, self.change)
        )
        values = torch.cat([now, goals], 1)
        whole = torch.cat([(values - mean) / std, (now - before) / change], 1)
        whole = whole.nan_to_num(nan=0.0, posinf=FURTHEST, neginf=-FURTHEST)
        return whole.clamp(-FURTHEST, FURTHEST).float()


def small_pictures(frames: Tensor, size: Sequence[int]) -> Tensor:
    """Frames `[N, 3, H, W]` uint8 in another size, by areas, as rows `[N, 3 · h · w]` uint8."""
    small = nn.functional.interpolate(frames.float(), size=(size[0], size[1]), mode="area")
    return small.round().byte().flatten(1)


def side_by_side(fields: Mapping[str, Any], shapes: Mapping[str, Sequence[int]]) -> Tensor:
    """The values of some fields `[N, …]` side by side, `[N, S]` in float64."""
    parts = [
        torch.as_tensor(fields[name], dtype=torch.float64).reshape(-1, math.prod(shape))
        for name, shape in shapes.items()
    ]
    return torch.cat(parts, 1)


@dataclass(frozen=True)
class PolicyCard:
    """What a saved policy is for, and how it was trained.

    Attributes:
        environment: name of the environment.
        task: name of the task.
        repeat: number of actions for which each of its actions is held.
        low: lower bounds of the actions, `[A]`.
        high: upper bounds, `[A]`.
        inputs: what it observes.
        layers: the network: widths of linear layers among names of others; see `networks`.
        training: how it was trained, for people.
        chunk: number of actions that it decides on at once.
    """

    environment: str
    task: str
    repeat: int
    low: list[float]
    high: list[float]
    inputs: PolicyInputs
    layers: list[int | str]
    training: dict[str, Any]
    chunk: int = 1


class SavedPolicy:
    """A policy as `acwm policy train` leaves it: an object of the kind that `OwnPolicy` takes.

    Args:
        card: what it is for.
        network: maps vectors `[N, O]` to actions `[N, A]`, scaled to [-1, 1].
    """

    def __init__(self, card: PolicyCard, network: nn.Module) -> None:
        self.card, self._network = card, network.eval()
        self._before: Tensor | None = None
        self._decided = list[Tensor]()
        aimless = not card.inputs.goal and not card.inputs.aims
        self._goal = torch.zeros(1, 0, dtype=torch.float64) if aimless else None

    @property
    def observes(self) -> Literal["frame", "state"]:
        """What `predict` takes."""
        return "frame" if self.card.inputs.picture else "state"

    @torch.no_grad()
    def scaled(self, vectors: Tensor) -> Tensor:
        """The next actions, scaled to [-1, 1], `[N, chunk, A]`, for observations `[N, O]`."""
        return self._network(vectors).unflatten(1, (self.card.chunk, -1))

    def reset(self, goal: Goal | None = None) -> None:
        """Start an episode; a policy without a task needs no goal.

        Raises:
            RecipeError: the policy needs a goal.
        """
        shapes = self.card.inputs.goal
        self._before, self._decided = None, []
        if goal is None and (shapes or self.card.inputs.aims):
            raise RecipeError("the policy needs its goal: call reset(goal)")
        self._goal = torch.zeros(1, 0, dtype=torch.float64)
        if goal is not None and self.card.inputs.aims:
            self._goal = self._picture(goal.frame)
        elif goal is not None and shapes:
            fields = {name: np.asarray(goal.state[name])[None] for name in shapes}
            self._goal = side_by_side(fields, shapes)

    def predict(self, seen: Mapping[str, NDArray[Any]] | NDArray[np.uint8]) -> NDArray[np.float32]:
        """The next raw action `[A]`; what is unknown is taken to be as it was.

        Args:
            seen: fields of the state, or a frame `[H, W, 3]`, as `observes` says.

        Raises:
            RecipeError: a field that the policy observes is missing, or no goal was given.
        """
        if self._goal is None:
            raise RecipeError("the policy needs its goal: call reset(goal) first")
        now = self._state(seen) if isinstance(seen, Mapping) else self._picture(seen)
        before = now if self._before is None else self._before
        self._before = now = torch.where(now.isfinite(), now, before)
        if not self._decided:
            vectors = self.card.inputs.vectors(now, before, self._goal)
            self._decided = [*self.scaled(vectors)[0]]
        return raw_actions(self._decided.pop(0), self.card.low, self.card.high).numpy()

    def _state(self, state: Mapping[str, NDArray[Any]]) -> Tensor:
        """The fields of the state that are observed, `[1, S]`."""
        shapes = self.card.inputs.state
        if self.card.inputs.picture:
            raise RecipeError("the policy observes pictures, and here are only states")
        if missing := [name for name in shapes if name not in state]:
            raise RecipeError(
                f"the policy observes {', '.join(missing)}, which nothing here reads: train one "
                f"with observe=[{', '.join(name for name in shapes if name in state)}]"
            )
        return side_by_side({name: np.asarray(state[name])[None] for name in shapes}, shapes)

    def _picture(self, frame: NDArray[np.uint8]) -> Tensor:
        """A frame `[H, W, 3]` as it is observed, a row of `small_pictures`."""
        if not self.card.inputs.picture or np.ndim(frame) != 3 or frame.shape[2] != 3:
            raise RecipeError("a policy observes states by name, or frames [H, W, 3], as trained")
        whole = torch.from_numpy(np.array(frame)).permute(2, 0, 1)[None]
        return small_pictures(whole, self.card.inputs.picture)

    def save(self, folder: Path) -> None:
        """Write the policy's file into a folder."""
        save_network(folder / POLICY_FILE, self._network, policy=self.card)

    @classmethod
    def read(cls, folder: Path) -> SavedPolicy:
        """The policy of a folder.

        Raises:
            DataError: there is none, or the file is damaged or of another version.
        """
        path = folder / POLICY_FILE
        if not path.is_file():
            raise DataError(f"{folder} holds no policy: train one with `acwm policy train`")
        return cls(*read_network(path, "policy", PolicyCard, _check_sizes))


def raw_actions(scaled: Tensor, low: Sequence[float], high: Sequence[float]) -> Tensor:
    """Actions scaled to [-1, 1], `[…, A]`, in the units of the environment, within its bounds."""
    least, most = (torch.tensor(bounds, dtype=torch.float64) for bounds in (low, high))
    raw = least + (scaled.double().clamp(-1, 1) + 1) / 2 * (most - least)
    return raw.float().clamp(least.float(), most.float())


class NetworkCard(Protocol):
    """What a file says of the network in it."""

    @property
    def layers(self) -> list[int | str]:
        """The network; see `PolicyCard`."""
        ...


Card = TypeVar("Card", bound=NetworkCard)


def save_network(path: Path, network: nn.Module, **card: Any) -> None:
    """Write a network in float32 into a file, with its card, a dataclass, by the card's name."""
    state = network.state_dict().items()
    weights = {name: value.float().contiguous() for name, value in state}
    details = {name: json.dumps(asdict(facts)) for name, facts in card.items()}
    with written_whole(path) as partial:
        partial.write_bytes(safetensors.torch.save(weights, details))


def read_network(
    path: Path, name: str, kind: type[Card], check: Callable[[Card, nn.Sequential], None]
) -> tuple[Card, nn.Sequential]:
    """The card and the network of a file that `save_network` has written.

    Args:
        path: the file.
        name: name of the card, such as ``policy``.
        kind: class of the card.
        check: raises ValueError for a network that does not fit its card.

    Raises:
        DataError: the file is damaged or of another version.
    """
    check_fetched(path)
    try:
        with safetensors.safe_open(path, "pt") as file:
            about: Any = (file.metadata() or {}).get(name, "null")
            weights: dict[str, Tensor] = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        card: Card = typed(parse_json(about), kind)
        network = network_of(card.layers, weights)
        check(card, network)
    except (ValueError, RuntimeError, KeyError, safetensors.SafetensorError) as error:
        raise DataError(
            f"{path} is no {name.replace('_', ' ')} of this version of acwm ({error})"
        ) from error
    return card, network


def _check_sizes(card: PolicyCard, network: nn.Sequential) -> None:
    """Refuse a network that does not fit what it observes or moves, by `ValueError`."""
    inputs = card.inputs
    state, goal = (sum(map(math.prod, shapes.values())) for shapes in (inputs.state, inputs.goal))
    sizes = len(inputs.mean), len(inputs.std), len(inputs.change)
    if inputs.picture and (
        len(inputs.picture) != 2 or not 1 <= min(inputs.picture) <= max(inputs.picture) <= MOST_SIDE
    ):
        raise ValueError("its pictures have no size")
    wanted = (state + goal, state + goal, state)
    if sizes != ((3 * math.prod(inputs.picture), 1, 1) if inputs.picture else wanted):
        raise ValueError("its sizes do not fit each other")
    with torch.no_grad():
        actions = network(torch.zeros(1, inputs.size))
    if actions.shape != (1, card.chunk * len(card.low)):
        raise ValueError("its sizes do not fit each other")
    if len(card.low) != len(card.high) or min(card.repeat, card.chunk) < 1:
        raise ValueError("its actions have no bounds")


def default_folder(task: str) -> Path:
    """Where `acwm policy train` writes a policy for ENVIRONMENT.TASK, and `acwm play` looks."""
    return Path("runs/policies") / task


def is_policy(name: str) -> bool:
    """Whether this is the folder of a saved policy."""
    return (Path(name) / POLICY_FILE).is_file()


def policy_for(name: str, card: EnvironmentCard, task: str | None = None) -> SavedPolicy:
    """The policy of a folder, for the environment and the task that it was trained for.

    Args:
        name: the folder.
        card: card of the environment.
        task: name of the task; any if None.

    Raises:
        RecipeError: it was trained for another environment or task.
    """
    policy = SavedPolicy.read(Path(name))
    wanted = card.name, task if task and policy.card.task else policy.card.task
    if (policy.card.environment, policy.card.task) != wanted:
        raise RecipeError(
            f"the policy {name} was trained for {policy.card.environment}.{policy.card.task}, not "
            f"for {'.'.join(wanted)}"
        )
    return policy
