"""The interface of the groups of a scene: what is read, moved and drawn alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch
from torch import Generator, Tensor, nn
from torch.utils import _pytree

from acwm_core.model.dynamics import Keypoints
from acwm_core.model.shapes import Latent

Tree = TypeVar("Tree")
"""A tensor, or a named tuple, tuple or dict of trees."""

DECLARED_WEIGHT = 4.0
"""Weight of the places of declared things as keypoints: as if they usually were a quarter of half
the picture apart, as the weights of learnt points count in standard deviations."""


def tree_map(function: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """The tree with a function applied to each tensor, and to those in its place in the others."""
    return cast(Any, _pytree).tree_map(function, tree, *others)


def at_frame(course: Tree, frame: int) -> Tree:
    """One frame of a course, whose tensors are `[B, T, …]`."""
    return tree_map(lambda values: values[:, frame], course)


def stacked(frames: Sequence[Tree]) -> Tree:
    """Several frames as a course."""
    return tree_map(lambda *values: torch.stack(values, 1), *frames)


def picked(course: Tree, numbers: Tensor) -> Tree:
    """The frames `[B, …]` of a course; numbers below 0 stand for the first one."""
    rows = torch.arange(len(numbers), device=numbers.device)
    rows = rows.view(-1, *[1] * (numbers.ndim - 1))
    return tree_map(lambda values: values[rows, numbers.clamp(min=0)], course)


def flattened(course: Tree) -> Tree:
    """The first two axes as one."""
    return tree_map(lambda values: values.flatten(0, 1), course)


def as_vectors(courses: Any) -> Tensor:
    """A course, or several, as one vector for each frame, `[B, T, V]`."""
    leaves = cast(list[Tensor], cast(Any, _pytree).tree_leaves(courses))
    return torch.cat([values.flatten(2).float() for values in leaves], 2)


def declared_keypoints(places: Tensor) -> Keypoints:
    """Keypoints at places `[B, T, N, 2]` of declared things, which all count alike."""
    weights = places.new_full(places.shape[2:], DECLARED_WEIGHT)
    return Keypoints(places, weights, torch.ones_like(weights[:, 0]))


def energy_score(
    draws: tuple[Tree, Tree], true: Tree, distance: Callable[[Tree, Tree], Tensor]
) -> Tensor:
    """The energy score of two draws (Gneiting and Raftery 2007, eq. 22), a scalar.

    ½ (‖x₁ − y‖ + ‖x₂ − y‖) − ½ ‖x₁ − x₂‖. Its expectation is least if draws have the distribution
    of the true futures.
    """
    first, second = draws
    return (distance(first, true) + distance(second, true) - distance(first, second)) / 2


class Group(nn.Module, ABC):
    """One kind of things in a scene: its reader, its mover and its painter.

    A *frame* is how the things are in one video frame, and a *course* in several: a tree of tensors
    `[B, …]` and `[B, T, …]`. A *state* is what moving them needs, in one video frame.

    Attributes:
        noise: numbers that a draw of their future depends on; 0 if there is one future.
        is_prepared: whether it knows the scale of its states.
        agent_size: how many of the values of its states, the first ones, are those of agents that
            `move_agents` moves; 0 if it cannot.
    """

    noise: int = 0
    agent_size: int = 0

    @property
    def is_prepared(self) -> bool:
        return True

    def prepare(self, mean: Tensor, std: Tensor) -> None:
        """Take the scale of its states, `[S]` each; for groups that need one."""

    @abstractmethod
    def encode(self, states: Tensor) -> Any:
        """The course in states `[B, T, S]`, as they were recorded."""

    @abstractmethod
    def decode(self, course: Any) -> Tensor:
        """The inverse of `encode`; NaN where nothing tells a value."""

    @abstractmethod
    def read(self, given: Latent) -> Any:
        """The state that the last of the given latent frames `[B, K, C, h, w]` shows."""

    @abstractmethod
    def begin(self, frame: Any, previous: Any) -> Any:
        """The state of things that are so, and were as in `previous` in the video frame before."""

    @abstractmethod
    def frame(self, state: Any) -> Any:
        """How things are in a state."""

    def past(self, state: Any, frames: int) -> Any:
        """The course of the last video frames until a state, the last one first; all alike."""
        return stacked([self.frame(state)] * frames)

    def with_draw(self, state: Any, draw: Tensor) -> Any:
        """The state with the numbers `[B, noise]` that its future depends on, as its `chance`."""
        return state._replace(chance=(draw,))

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """The things whose place in the picture it knows, if it does."""
        return ()

    def keypoints(self, course: Any, aspect: float) -> Keypoints:
        """Where they are in a course; for groups with `keypoint_names`.

        Args:
            course: `[B, T, …]`.
            aspect: width of the picture by its height.
        """
        raise NotImplementedError

    @abstractmethod
    def embed(self, modulation: Tensor) -> Tensor:
        """Actions `[B, L, width]` as they move things, `[B, L, …]`; none moves the first one."""

    @abstractmethod
    def move(self, state: Any, actions: Tensor) -> tuple[Any, Any]:
        """The state one latent frame later, and the course of its video frames.

        Args:
            state: in the last video frame of the latent frame before.
            actions: one of the rows of `embed`, `[B, …]`.

        Returns:
            The state in the last video frame, and a course `[B, stride, …]`.
        """

    def move_agents(self, state: Any, actions: Tensor) -> tuple[Any, Tensor]:
        """As `move`, of the agents alone; for groups with an `agent_size`.

        Returns:
            The state, in which all else is as it was, and the first values of the states,
            `[B, stride, agent_size]`.
        """
        raise NotImplementedError

    @abstractmethod
    def canvas(self, features: Tensor, past: Any) -> tuple[Tensor, Any]:
        """What its painter adds to what all frames start from, and what it remembers.

        Args:
            features: of the cells of the given latent frame, `[B, channels, h, w]`.
            past: the course of its video frames, the last one first, `[B, stride, …]`.

        Returns:
            `[B, channels, h, w]`, and a tree of tensors `[B, …]` for `paint`.
        """

    @abstractmethod
    def paint(self, memory: Any, course: Any, size: torch.Size) -> tuple[Tensor, Tensor]:
        """What its painter adds to a latent frame.

        Args:
            memory: what `canvas` returned.
            course: the course of its video frames, the last one first, `[B, stride, …]`.
            size: rows and columns of cells.

        Returns:
            A map `[B, channels, h, w]`, and the vector `[B, width]` that modulates the blocks.
        """

    def as_read(self, base: Tensor, course: Any) -> Any:
        """A true course as drawing is learnt from it: while training, as wrong as it is read.

        Args:
            base: the latent frame that shows the first frame of the course, `[B, C, h, w]`.
            course: `[B, T, …]`.
        """
        return course

    @abstractmethod
    def reading_loss(self, latents: Tensor, true: Any) -> Tensor:
        """The error of what it reads from latent frames `[N, C, h, w]`, a scalar.

        Args:
            latents: the frames.
            true: how things are in their last video frames, `[N, …]`.
        """

    @abstractmethod
    def motion_loss(
        self, states: Tensor, actions: Tensor, random: Generator, progress: float
    ) -> Tensor:
        """The error of how it moves things, without pictures, a scalar.

        Args:
            states: of clips, as they were recorded, `[B, T, S]`.
            actions: what `embed` makes of their actions.
            random: a CPU generator, the only source of randomness.
            progress: share of the training that is over, 0 to 1; short windows come first.
        """

    @abstractmethod
    def movers(self) -> Sequence[nn.Module]:
        """The modules that move things."""


class SteppedGroup(Group):
    """A group of things that move from video frame to video frame, as their states are known.

    Its `embed` returns `[B, L, stride, …]`.
    """

    @abstractmethod
    def step(self, state: Any, action: Tensor) -> Any:
        """The state one video frame later.

        Args:
            state: in the video frame before.
            action: that of the video frame, `[B, …]`.
        """

    def move(self, state: Any, actions: Tensor) -> tuple[Any, Any]:
        """The state one latent frame later; see `Group.move`."""
        frames: list[Any] = []
        for action in actions.unbind(1):
            state = self.step(state, action)
            frames.append(self.frame(state))
        return state, stacked(frames)
