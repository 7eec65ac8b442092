"""`StateStream`: predicts the states of many scenes step by step, without pictures."""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from typing import Any, Protocol, cast

import torch
from torch import Tensor

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Predictor
from acwm_core.model.shapes import Actions, Video, float32_by_default
from acwm_core.model.stream import Streamed


class Stated(Streamed, Protocol):
    """What a stream of states asks of a `WorldModel`."""

    def named_states(self, values: Tensor) -> dict[str, Tensor]: ...  # noqa: D102


class StateStream:
    """Scenes side by side that actions move, of which only the states are predicted.

    Scenes may begin at different times: those that are over are replaced by others (`put`).

    Args:
        world: the world model, whose dynamics model carries states.
        given: the first K frames of each scene, `[B, K, 3, H, W]` in [0, 1], whole latent frames.
        actions: raw actions between them, `[B, K − 1, A]`.
        generators: generators of the noise, one per scene, on the CPU.

    Raises:
        RecipeError: the model carries no states, or the conditioner embeds all actions at once.
        ShapeError: frames and actions do not fit.
    """

    def __init__(
        self, world: Stated, given: Video, actions: Actions, generators: Sequence[torch.Generator]
    ) -> None:
        self._world, self._stride = world, world.codec.temporal_stride
        if list(actions.shape[:2]) != [len(given), given.shape[1] - 1]:
            raise ShapeError(
                f"between {given.shape[1]} frames there are actions "
                f"{[len(given), given.shape[1] - 1, 'A']}, not {list(actions.shape)}"
            )
        history = world.conditioner.history
        if history is None:
            raise RecipeError(
                f"{type(world.conditioner).__name__} embeds all actions since the start (its "
                "history is None), so states cannot be carried on"
            )
        # One step more than an embedding depends on: the first latent frame of a clip is special.
        self._most = max(history, 1) + 1
        shape = actions.shape[1] // self._stride, self._stride, actions.shape[2]
        between = world.normalise(actions).reshape(len(given), *shape)[:, -self._most :]
        blank = between.new_zeros(len(given), self._most - between.shape[1], *between.shape[2:])
        self._recent = torch.cat([blank, between], 1)
        self._known = torch.full((len(given),), between.shape[1])
        with torch.no_grad():
            latents = world.codec.encode(given)
            self._states = cast(Predictor, world.model).carry_states(latents, generators)

    def __len__(self) -> int:
        return len(self._known)

    @property
    def current(self) -> dict[str, Tensor]:
        """The fields of the state in the last video frame, `[B, …]`; NaN where none is known."""
        named = self._world.named_states(self._states.current[:, None])
        return {name: values[:, 0] for name, values in named.items()}

    @float32_by_default()
    def step(self, actions: Actions) -> dict[str, Tensor]:
        """The fields of the state in the video frames that a latent step leads to.

        If the actions require a gradient, the fields have one, by all steps so far whose actions
        did, until the scenes are `picked` under `torch.no_grad`.

        Args:
            actions: raw actions `[B, temporal_stride, A]`; the first acts on the last frame so far.

        Returns:
            By name, `[B, temporal_stride, …]` in the units of the card; NaN where none is known.

        Raises:
            ShapeError: the actions have the wrong size, are not finite, or are out of bounds.
        """
        wanted = [len(self), self._stride]
        if actions.ndim != 3 or list(actions.shape[:2]) != wanted:
            raise ShapeError(f"a step takes actions {[*wanted, 'A']}, not {list(actions.shape)}")
        with torch.set_grad_enabled(torch.is_grad_enabled() and actions.requires_grad):
            rows = self._world.normalise(self._world.checked(actions))
            self._recent = torch.cat([self._recent[:, 1:], rows[:, None]], 1)
            self._known = (self._known + 1).clamp(max=self._most)
            return self._world.named_states(self._states.advance(self._embed()))

    def picked(self, rows: Tensor) -> StateStream:
        """A stream of some of the scenes, by their numbers `[N]`, each as often as it is named."""
        other = copy.copy(self)
        other._recent, other._known = self._recent[rows.to(self._recent.device)], self._known[rows]
        other._states = self._states.picked(rows)
        return other

    def only(self, fields: Collection[str]) -> StateStream:
        """The same scenes for who needs these fields alone: the others may become NaN.

        Raises:
            KeyError: the model predicts no field of this name.
        """
        size = self._states.current.shape[1]
        numbers = self._world.named_states(torch.arange(size).expand(1, 1, size))
        columns = {int(number) for name in fields for number in numbers[name].flatten()}
        other = copy.copy(self)
        other._states = self._states.only(columns)
        return other

    def put(self, rows: Tensor, others: StateStream) -> None:
        """Replace the scenes of these numbers `[N]` by the N scenes of another stream."""
        self._recent, self._known = self._recent.clone(), self._known.clone()
        self._recent[rows.to(self._recent.device)] = others._recent
        self._known[rows] = others._known
        self._states.put(rows, others._states)

    def _embed(self) -> Conditioning:
        """The embedded actions of the last and the next latent frame, of all scenes.

        Scenes that have just begun have fewer actions behind them, so they are embedded apart. As
        in clips, the actions end with a row of zeros, which leads to no frame.
        """
        world, parts = self._world, list[tuple[Tensor, Conditioning]]()
        counts = cast(list[int], cast(Any, self._known).tolist())
        for known in sorted({*counts}):
            numbers = [row for row, count in enumerate(counts) if count == known]
            rows = torch.tensor(numbers, device=self._recent.device)
            taken = self._recent[rows, -known:].flatten(1, 2)
            end = world.normalise(torch.zeros_like(taken[:, :1]))
            width = world.model.width
            embedded = world.conditioner.condition(torch.cat([taken, end], 1), known + 1, width)
            parts.append((rows, embedded.frames(known - 1, known + 1)))
        if len(parts) == 1:
            return parts[0][1]
        order = torch.cat([rows for rows, _ in parts]).argsort()

        def joined(name: str) -> Tensor | None:
            values = [getattr(part, name) for _, part in parts]
            return None if values[0] is None else torch.cat(values)[order]

        return Conditioning(joined("modulation"), joined("context"), world.conditioner)
