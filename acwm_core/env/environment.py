"""The `Environment` interface: a `gymnasium.Env` with a card, ground truth and a scripted policy.

An author writes a card and six small methods (`_start`, `_advance`, `_render`, `_state`,
`_contacts`, `policy`); this base class turns them into a deterministic Gymnasium environment.
"""

from __future__ import annotations

import operator
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionSpec as ActionSpec
from acwm_core.env.card import EnvironmentCard as EnvironmentCard
from acwm_core.env.card import StateField as StateField
from acwm_core.env.episode import EpisodeSpec, FactorValue, draw_factors, ood_label
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import AcwmError, RecipeError, ShapeError


def checked_seed(seed: object) -> int | None:
    """The seed of one environment as a Python integer; NumPy's integers are taken, too.

    Raises:
        ShapeError: it is not a whole number of 0 or more.
    """
    if seed is None:
        return None
    try:
        whole = operator.index(cast(Any, seed))
    except TypeError:
        whole = -1
    if whole < 0:
        raise ShapeError(f"a seed is a whole number of 0 or more, not {seed!r:.60}")
    return whole


def check_process(used_in: int | None) -> None:
    """Refuse to simulate in a process that was forked after a simulator was used.

    Args:
        used_in: id of the process that first used the simulator; None if none did.

    Raises:
        AcwmError: that is another process, where the simulator would wait without end.
    """
    if used_in not in (None, os.getpid()):
        raise AcwmError(
            "a simulator was used before this process was forked and cannot be used here: start "
            "workers with multiprocessing's 'forkserver' or 'spawn', as in gymnasium.make_vec(…, "
            "vectorization_mode='async', vector_kwargs={'context': 'forkserver'})"
        )


_OPENGL = ("OpenGL", "glfw", "pyglet", "moderngl")
"""Libraries by which simulators draw, and which a fork breaks."""

_drawn_in: int | None = None  # the process that first drew an environment by one of `_OPENGL`


Policy = Callable[[], NDArray[np.floating[Any]]]
"""A behaviour policy: each call reads the simulator and returns the next raw action, `[A]`."""


class Environment(gymnasium.Env[NDArray[np.uint8], NDArray[np.float32]], ABC):
    """A simulated scene that returns frames and exact ground truth for each action.

    Observations are ``[H, W, 3]`` uint8 frames. Actions are raw float32 vectors in the units of the
    card. Rewards are 0 unless an environment defines one. An episode is truncated after
    ``card.horizon`` frames. `info` holds ``state`` (arrays by name), ``mask`` ``[H, W]`` uint8,
    ``contacts`` (a tuple of pairs of instance ids), ``factors`` and ``ood_label``.

    A subclass sets `card` and writes the six abstract methods. All randomness must come from the
    generators that are passed to it, and `_start` must reset everything from earlier episodes.

    Args:
        size: frame size, one side or ``(H, W)``; the card's by default. The framing stays the same.
        render_mode: as in Gymnasium; frames are always rendered in software, to arrays.

    Raises:
        ShapeError: the size is not possible.
        RecipeError: there is no such render mode.
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
        if render_mode not in (None, "rgb_array"):  # Gymnasium passes on any value
            raise RecipeError(f"render_mode={render_mode!r}: frames are rendered as 'rgb_array'")
        self.render_mode = render_mode
        action = self.card.action
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(0, 255, (*self.frame_size, 3), np.uint8)
        self._frame_index = 0
        self._spec: EpisodeSpec | None = None
        self._factors: dict[str, FactorValue] = {}
        self._ood_label: str | None = None

    # What an author writes ---------------------------------------------------------------------

    @abstractmethod
    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        """Build the first state from the factor values; all randomness comes from `rng`."""

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
        """Pairs of ids of instances that touched since the last frame (or touch at the start)."""

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Perturb the start state a little, right after `_start`; optional.

        The predictability horizon is measured with it: the same actions from a start that differs
        invisibly. An `amount` of 1 moves bodies by about 1 mm and turns joints and bodies by about
        1 mrad, normally distributed; `amount` is always positive. The start must stay physical: at
        rest, and without overlapping bodies.
        """
        raise RecipeError(f"{self.card.name} has no perturbed start")

    def _transform(self, symmetry: Symmetry) -> None:
        """Transform the start state by one of the card's symmetries, right after `_start`.

        An environment whose card declares symmetries needs it: by it they are checked.
        """
        raise RecipeError(f"{self.card.name} has no transformed start")

    def _snapshot(self) -> Callable[[], None] | None:
        """A function that brings the simulator back to this moment, bit for bit; optional.

        It may be called again and again, until the next `_start`. Planning with the simulator
        branches with it; without it (None), every branch repeats the episode from its start.
        """
        return None

    @abstractmethod
    def policy(self, rng: np.random.Generator) -> Policy:
        """Return the scripted policy that collects data, starting in the current state.

        The policy may read the simulator, must stay within the action bounds, and draws all
        randomness from `rng`. Call this method right after `reset`.
        """

    # What a user calls -------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start an episode: that of ``options["spec"]``, or a new one drawn from `seed`.

        Args:
            seed: seeds the sequence of episodes, as in Gymnasium.
            options: ``{"spec": EpisodeSpec}`` selects the episode; ``{"split": …}`` and
                ``{"factors": {name: setting}}`` configure a new one. ``{"perturbation": amount}``
                perturbs its start, see `_perturb`, and ``{"perturbed_start": k}`` the k-th time;
                ``{"symmetry": Symmetry}`` transforms it before that, see `_transform`.

        Raises:
            RecipeError: unknown split or factor, an impossible factor value, no perturbed or no
                transformed start.
            ShapeError: the seed is not a whole number of 0 or more.
            AcwmError: an environment was drawn by OpenGL before this process was forked.
        """
        check_process(_drawn_in)
        super().reset(seed=checked_seed(seed))
        options = options or {}
        spec = cast(EpisodeSpec | None, options.get("spec"))
        if spec is None:
            split, factors = options.get("split", "train"), options.get("factors", {})
            index = int(self.np_random.integers(2**31))
            spec = EpisodeSpec(self.card.name, split, index, seed=0, factors=factors)
        self._spec = spec
        self._factors = draw_factors(spec, self.card.factors, self.card.ood_shifts)
        self._ood_label = ood_label(self.card.factors, self._factors)
        self._frame_index = 0
        self._start(dict(self._factors), spec.rng("start"))
        if symmetry := options.get("symmetry"):
            self._transform(symmetry)
        amount = options.get("perturbation", 0.0)
        if not isinstance(amount, (int, float)) or not 0 <= amount < np.inf:
            raise RecipeError(f"perturbation={amount!r}: give 0 or a positive number")
        if amount > 0:
            start = int(options.get("perturbed_start", 0))
            stream = f"perturbation {start}" if start else "perturbation"
            self._perturb(float(amount), spec.rng(stream))
        return self.observe()

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Apply one raw action for one frame.

        Raises:
            ShapeError: wrong shape, not finite, or out of bounds (wrap the environment in
                `gymnasium.wrappers.ClipAction` to clip instead).
        """
        self.advance(action)
        frame, info = self.observe()
        truncated = self._frame_index >= self.card.horizon - 1
        return frame, self._reward(), False, truncated, info

    def advance(self, action: NDArray[np.floating[Any]]) -> None:
        """As `step`, but without rendering and observing, which takes most of the time."""
        if self._spec is None:
            raise AcwmError("call reset() before step()")
        self._advance(self._checked(action))
        self._frame_index += 1

    def snapshot(self) -> Callable[[], None] | None:
        """A function that returns to this moment of the episode, any number of times until `reset`.

        None if the environment cannot do that; repeating the actions always leads there.
        """
        back, index = self._snapshot(), self._frame_index
        if back is None:
            return None

        def restore() -> None:
            back()
            self._frame_index = index

        return restore

    def render(self) -> NDArray[np.uint8]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The current frame, `[H, W, 3]` uint8."""
        return self._drawn()[0]

    def _drawn(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """What `_render` returns."""
        global _drawn_in
        frame, mask = self._render()
        if _drawn_in is None and any(name in sys.modules for name in _OPENGL):
            _drawn_in = os.getpid()
        return frame, mask

    def observe(self) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """The current frame and info, as `reset` and `step` return them."""
        frame, mask = self._drawn()
        index = operator.index  # refuses values that are not integers
        contacts = sorted({(index(min(pair)), index(max(pair))) for pair in self._contacts()})
        return frame, {
            "state": self._state(),
            "mask": mask,
            # Not an array: its length would vary, and vector environments stack arrays.
            "contacts": tuple(contacts),
            "factors": dict(self._factors),
            "ood_label": self._ood_label,
        }

    def observe_state(self) -> dict[str, NDArray[Any]]:
        """The fields of the state now, by name, as in `info`, without rendering."""
        return self._state()

    def still_action(self) -> NDArray[np.float32]:
        """The raw action `[A]` that commands no motion now: zero, clipped to the action bounds.

        An environment with absolute actions overrides it with the current positions.
        """
        action = self.card.action
        return np.clip(np.zeros(action.size, np.float32), action.low, action.high, dtype=np.float32)

    @property
    def episode_spec(self) -> EpisodeSpec:
        """The spec of the current episode."""
        if self._spec is None:
            raise AcwmError("call reset() before anything else")
        return self._spec

    @property
    def can_be_perturbed(self) -> bool:
        """Whether the environment implements `_perturb`."""
        return type(self)._perturb is not Environment._perturb

    # Inner workings ----------------------------------------------------------------------------

    def _reward(self) -> float:
        """Reward of the last step; 0 unless an environment defines a task."""
        return 0.0

    def _checked(self, action: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        values, spec = np.asarray(action, np.float32), self.card.action
        if values.shape != (spec.size,):
            raise ShapeError(
                f"{self.card.name} takes an action of shape ({spec.size},), not {values.shape}"
            )
        if not np.all(np.isfinite(values)):
            raise ShapeError(f"{self.card.name} was given an action that is not finite: {values}")
        low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        slack = 1e-6 * (high - low)  # float32 rounding of a bound is no violation
        for name, value, at_least, at_most in zip(
            spec.names, values, low - slack, high + slack, strict=True
        ):
            if not at_least <= value <= at_most:
                raise ShapeError(
                    f"action {name}={value:g} of {self.card.name} is out of its bounds "
                    f"[{at_least:g}, {at_most:g}]; wrap it in gymnasium.wrappers.ClipAction to clip"
                )
        return np.clip(values, low, high)


def resolve_size(size: int | tuple[int, int] | None, default: tuple[int, int]) -> tuple[int, int]:
    """Return ``(H, W)`` for a height, a pair, or None (the default).

    For a height, the width is the multiple of 8 that best keeps the default's aspect ratio.

    Raises:
        ShapeError: a side is below 16 or not a multiple of 8, which no codec could encode.
    """
    if size is None:
        return default
    if isinstance(size, int):
        size = (size, 8 * round(size * default[1] / default[0] / 8))
    height, width = size
    if min(height, width) < 16 or height % 8 or width % 8:
        raise ShapeError(f"frame size {height}×{width}: each side must be a multiple of 8, ≥ 16")
    return (height, width)
