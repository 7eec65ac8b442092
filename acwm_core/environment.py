"""The `Environment` interface: a `gymnasium.Env` with a card, ground truth and a scripted policy.

An author writes a card and six small methods (`_start`, `_advance`, `_render`, `_state`,
`_contacts`, `policy`); this base class makes a deterministic Gymnasium environment of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acwm_core.episode import (
    EpisodeSpec,
    Factor,
    FactorSetting,
    FactorValue,
    draw_factors,
    ood_label,
)
from acwm_core.errors import ActionError, RecipeError, ShapeError

Policy = Callable[[], NDArray[np.floating[Any]]]
"""A behaviour policy: each call looks at the simulator and returns the next raw action, `[A]`."""


@dataclass(frozen=True)
class ActionSpec:
    """What the numbers of an action mean.

    Attributes:
        names: one per dimension, e.g. ``("target_x", "target_y")``.
        units: one per dimension, e.g. ``("m", "m")``; ``""`` for a pure number.
        low: lower bounds in these units; models normalise actions to [-1, 1] by the bounds.
        high: upper bounds.
        kind: what an action commands.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    kind: Literal["absolute", "delta", "torque"]

    def __post_init__(self) -> None:
        lengths = {len(self.names), len(self.units), len(self.low), len(self.high)}
        if len(lengths) != 1:
            raise ShapeError("an ActionSpec needs a name, a unit, a low and a high per dimension")
        if any(low >= high for low, high in zip(self.low, self.high, strict=True)):
            raise ShapeError("every lower action bound must lie below its upper bound")

    @property
    def size(self) -> int:
        """Number of action dimensions A."""
        return len(self.names)


@dataclass(frozen=True)
class StateField:
    """One named array of ground truth, recorded in every frame.

    Attributes:
        name: key in `Episode.states`.
        shape: shape of one frame's value.
        unit: e.g. ``"m"``; ``""`` for none.
        description: one phrase, saying the frame of reference where there is one.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    description: str


@dataclass(frozen=True)
class EnvironmentCard:
    """What a user, a dataset and a model need to know of an environment without running it.

    Attributes:
        name: registered name.
        summary: one sentence.
        action: meaning and bounds of the action.
        frame_size: default ``(H, W)``.
        fps: frames, and so actions, per second.
        horizon: frames of an episode, T.
        factors: everything that can vary.
        ood_shifts: names of the factors that `ood_test` shifts, one per episode in turn.
        state: the ground-truth arrays.
        instances: names of the mask ids, in order; id 0 is the background.
        engine: the simulator, e.g. ``"MuJoCo"``.
        episodes: size of the full benchmark per split.
        variants: other registered names that are variants of this environment.
        citation: where the task comes from.
    """

    name: str
    summary: str
    action: ActionSpec
    frame_size: tuple[int, int]
    fps: int
    horizon: int
    factors: tuple[Factor, ...]
    ood_shifts: tuple[str, ...]
    state: tuple[StateField, ...]
    instances: tuple[str, ...]
    engine: str
    episodes: Mapping[str, int] = field(default_factory=dict[str, int])
    variants: tuple[str, ...] = ()
    citation: str = ""

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict, the inverse of `from_dict`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> EnvironmentCard:
        """Read what `to_dict` wrote, also after a round trip through JSON or YAML."""
        values = {name: _tuples(value) for name, value in fields.items()}
        values["action"] = ActionSpec(**_fields(fields["action"]))
        values["factors"] = tuple(Factor(**_fields(f)) for f in fields["factors"])
        values["state"] = tuple(StateField(**_fields(f)) for f in fields["state"])
        values["episodes"] = dict(fields.get("episodes", {}))
        return cls(**values)


def _fields(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuples(value) for name, value in values.items()}


def _tuples(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(item) for item in cast(Iterable[Any], value))
    return value


class Environment(gymnasium.Env[NDArray[np.uint8], NDArray[np.float32]], ABC):
    """A simulated scene that answers actions with frames and exact ground truth.

    Observations are ``[H, W, 3]`` uint8 frames, actions raw float32 vectors in the units of the
    card, rewards 0 unless an environment defines one; an episode is truncated after
    ``card.horizon`` frames. `info` holds ``state`` (arrays by name), ``mask`` ``[H, W]`` uint8,
    ``contacts`` (a tuple of pairs of instance ids), ``factors`` and ``ood_label``.

    A subclass sets `card` and writes the six abstract methods. Everything random must come from
    the generators it is handed, and `_start` must leave nothing of an earlier episode behind.

    Args:
        size: frame size, a side or ``(H, W)``; the card's by default. The framing does not change.
        render_mode: Gymnasium's; frames are always rendered in software, to arrays.

    Raises:
        ShapeError: a size that is not possible.
        RecipeError: a render mode that there is not.
    """

    card: EnvironmentCard

    def __init__(
        self,
        *,
        size: int | tuple[int, int] | None = None,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        self.frame_size = resolve_size(size, self.card.frame_size)
        self.card = replace(self.card, frame_size=self.frame_size)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": self.card.fps}
        if render_mode not in (None, "rgb_array"):  # Gymnasium passes on whatever it was given
            raise RecipeError(f"render_mode={render_mode!r}: frames are rendered as 'rgb_array'")
        self.render_mode = render_mode
        action = self.card.action
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(0, 255, (*self.frame_size, 3), np.uint8)
        self._frame_index = 0
        self._spec: EpisodeSpec | None = None
        self._factors: dict[str, FactorValue] = {}

    # What an author writes ---------------------------------------------------------------------

    @abstractmethod
    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        """Build the first state from the factors' values; all randomness comes from `rng`."""

    @abstractmethod
    def _advance(self, action: NDArray[np.float32]) -> None:
        """Simulate one frame interval, ``1 / fps`` seconds, under a checked raw action `[A]`."""

    @abstractmethod
    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The current frame `[H, W, 3]` and its instance mask `[H, W]`, both uint8."""

    @abstractmethod
    def _state(self) -> dict[str, NDArray[Any]]:
        """The current value of every state field on the card, freshly allocated."""

    @abstractmethod
    def _contacts(self) -> Iterable[tuple[int, int]]:
        """Pairs of instance ids that touched since the last frame (or at the start)."""

    @abstractmethod
    def policy(self, rng: np.random.Generator) -> Policy:
        """The scripted behaviour that collects data, from the current state of this environment.

        It may look at the simulator, must stay within the action bounds and draws all randomness
        from `rng`. Call it right after `reset`.
        """

    # What a user calls -------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start an episode: the one of ``options["spec"]``, or a fresh one drawn from `seed`.

        Args:
            seed: seeds the sequence of episodes, as Gymnasium defines it.
            options: ``{"spec": EpisodeSpec}`` names the episode; ``{"split": …}`` and
                ``{"factors": {name: setting}}`` shape a fresh one.

        Raises:
            RecipeError: unknown split or factor, or an impossible factor value.
        """
        super().reset(seed=seed)
        self._spec = self._episode_spec(options or {})
        self._factors = draw_factors(self._spec, self.card.factors, self.card.ood_shifts)
        self._frame_index = 0
        self._start(self._factors, self._spec.rng("start"))
        frame, info = self._observe()
        return frame, info

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Apply one raw action for one frame.

        Raises:
            ActionError: wrong shape, not finite, or out of bounds (wrap the environment in
                `gymnasium.wrappers.ClipAction` to clip instead).
        """
        if self._spec is None:
            raise ActionError("call reset() before step()")
        self._advance(self._checked(action))
        self._frame_index += 1
        frame, info = self._observe()
        truncated = self._frame_index >= self.card.horizon - 1
        return frame, self._reward(), False, truncated, info

    def render(self) -> NDArray[np.uint8]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The current frame, `[H, W, 3]` uint8."""
        return self._render()[0]

    @property
    def spec_of_episode(self) -> EpisodeSpec:
        """The spec of the running episode."""
        if self._spec is None:
            raise ActionError("call reset() first: there is no episode yet")
        return self._spec

    # Inner workings ----------------------------------------------------------------------------

    def _reward(self) -> float:
        """Reward of the last step; 0 unless an environment defines a task."""
        return 0.0

    def _observe(self) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        frame, mask = self._render()
        contacts = sorted({(int(min(pair)), int(max(pair))) for pair in self._contacts()})
        info = {
            "state": self._state(),
            "mask": mask,
            # Not an array, whose length would vary: vector environments stack arrays.
            "contacts": tuple(contacts),
            "factors": dict(self._factors),
            "ood_label": ood_label(self.card.factors, self._factors),
        }
        return frame, info

    def _episode_spec(self, options: Mapping[str, Any]) -> EpisodeSpec:
        if "spec" in options:
            return cast(EpisodeSpec, options["spec"])
        factors: Mapping[str, FactorSetting] = options.get("factors", {})
        index = int(self.np_random.integers(2**31))
        return EpisodeSpec(
            self.card.name, options.get("split", "train"), index, seed=0, factors=factors
        )

    def _checked(self, action: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        values = np.asarray(action, np.float32)
        spec = self.card.action
        if values.shape != (spec.size,):
            raise ActionError(
                f"{self.card.name} takes an action of shape ({spec.size},), not {values.shape}"
            )
        if not np.all(np.isfinite(values)):
            raise ActionError(f"{self.card.name} was given an action that is not finite: {values}")
        low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        slack = 1e-6 * (high - low)  # float32 rounding of a bound is no violation
        for name, value, at_least, at_most in zip(
            spec.names, values, low - slack, high + slack, strict=True
        ):
            if not at_least <= value <= at_most:
                raise ActionError(
                    f"action {name}={value:g} of {self.card.name} is out of its bounds "
                    f"[{at_least:g}, {at_most:g}]; wrap it in gymnasium.wrappers.ClipAction to clip"
                )
        return np.clip(values, low, high)


def resolve_size(size: int | tuple[int, int] | None, default: tuple[int, int]) -> tuple[int, int]:
    """``(H, W)`` from a height, a pair, or None.

    A height keeps the default's aspect ratio as nearly as a width that is a multiple of 8 can.

    Raises:
        ShapeError: a side below 16 or that is not a multiple of 8, which no codec could fold.
    """
    if size is None:
        return default
    if isinstance(size, int):
        size = (size, 8 * round(size * default[1] / default[0] / 8))
    height, width = size
    if min(height, width) < 16 or height % 8 or width % 8:
        raise ShapeError(f"frame size {height}×{width}: each side must be a multiple of 8, ≥ 16")
    return (height, width)
