"""Episodes of Gymnasium environments, one after the other or several at once, frame by frame."""

from __future__ import annotations

import copy
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import DataError
from acwm_formats.texts import text_facts
from acwm_formats.timeline import Recording

OBSERVATION = "observation"

Policy = Callable[[Any, np.random.Generator], Any]
"""Maps an observation and the random generator of the episode to an action."""

Env = gymnasium.Env[Any, Any]
Vector = VectorEnv[Any, Any, Any]


class Stage(Protocol):
    """One environment or several, all of which are asked at once.

    Attributes:
        action_space: of each.
        observation_space: of each.
        metadata: what they say of themselves.
        count: how many they are.
        shows_last: whether the last frame of an episode that ends by itself is shown, before the
            first of the next.
    """

    action_space: Any
    observation_space: Any
    metadata: Mapping[str, Any]
    count: int
    shows_last: bool

    def reset(self, seeds: Sequence[int]) -> Sequence[Any]:
        """Begin an episode in each; returns the observations."""
        ...

    def step(self, actions: Sequence[Any]) -> tuple[Sequence[Any], Sequence[bool]]:
        """Act in each; returns the observations, and whether an episode ends."""
        ...

    def render(self) -> Sequence[Any]:
        """What each shows now."""
        ...


class Single:
    """A single environment; see `Stage`."""

    count, shows_last = 1, True

    def __init__(self, env: Env) -> None:
        self._env = env
        self.action_space: Any = env.action_space
        self.observation_space: Any = env.observation_space
        self.metadata: Mapping[str, Any] = env.metadata

    def reset(self, seeds: Sequence[int]) -> Sequence[Any]:
        """As in `Stage`."""
        return [self._env.reset(seed=seeds[0])[0]]

    def step(self, actions: Sequence[Any]) -> tuple[Sequence[Any], Sequence[bool]]:
        """As in `Stage`."""
        seen, _, terminated, truncated, _ = self._env.step(actions[0])
        return [seen], [bool(terminated or truncated)]

    def render(self) -> Sequence[Any]:
        """As in `Stage`."""
        return [self._env.render()]


class Several:
    """A vector environment in any of Gymnasium's modes of autoreset; see `Stage`.

    Raises:
        DataError: it does not say its mode.
    """

    def __init__(self, env: Vector) -> None:
        self._env, self.count = env, env.num_envs
        self.action_space: Any = env.single_action_space
        self.observation_space: Any = env.single_observation_space
        self.metadata: Mapping[str, Any] = env.metadata
        mode = env.metadata.get("autoreset_mode")
        if not isinstance(mode, AutoresetMode):
            raise DataError(
                "the vector environment does not say when it resets: its metadata need "
                "autoreset_mode, an AutoresetMode of gymnasium.vector"
            )
        self.shows_last = mode != AutoresetMode.SAME_STEP
        self._resets_itself = mode != AutoresetMode.DISABLED
        self._ended = np.zeros(self.count, bool)

    def reset(self, seeds: Sequence[int]) -> Sequence[Any]:
        """As in `Stage`; environments that take one seed for all are given the first."""
        several = isinstance(self._env.unwrapped, SyncVectorEnv | AsyncVectorEnv)
        seen, _ = self._env.reset(seed=cast(Any, list(seeds)) if several else seeds[0])
        self._ended[:] = False
        return self._each(seen)

    def step(self, actions: Sequence[Any]) -> tuple[Sequence[Any], Sequence[bool]]:
        """As in `Stage`."""
        if self._ended.any() and not self._resets_itself:
            self._env.reset(options={"reset_mask": self._ended.copy()})
        joint = create_empty_array(self.action_space, self.count)
        joint = concatenate(self.action_space, actions, cast(Any, joint))
        seen, _, terminated, truncated, _ = self._env.step(joint)
        self._ended = np.logical_or(terminated, truncated)
        return self._each(seen), self._ended.tolist()

    def _each(self, seen: Any) -> Sequence[Any]:
        return list(iterate(self._env.observation_space, seen))

    def render(self) -> Sequence[Any]:
        """As in `Stage`."""
        images: Any = self._env.render()
        if (
            not isinstance(images, list | tuple | np.ndarray)
            or len(cast(Any, images)) != self.count
        ):
            raise DataError(f"its render() returns no frame for each of its {self.count}")
        return cast(Sequence[Any], images)


@dataclass
class Take:
    """An episode that is played: what was shown, done and seen, as copies.

    Attributes:
        policy: who acts; None samples actions.
        space: of the actions.
        rng: the random generator of the policy.
        limit: most frames.
        said: texts among the observations, by name.
    """

    policy: Policy | None
    space: Any
    rng: np.random.Generator
    limit: int
    images: list[NDArray[np.uint8]] = field(default_factory=list[NDArray[np.uint8]])
    taken: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])
    seen: list[NDArray[Any]] = field(default_factory=list[NDArray[Any]])
    said: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    ended: bool = False
    action: Any = None  # the last one

    def act(self, observation: Any) -> Any:
        """The next action; after the end the last one, which counts for nothing."""
        if not self.ended:
            action = self.policy(observation, self.rng) if self.policy else self.space.sample()
            self.action = copy.deepcopy(action)  # a policy may reuse its array
        return copy.deepcopy(self.action)  # and so may an environment

    def show(self, observation: Any, image: Any) -> None:
        """Keep what is seen, and the action that led to it."""
        if self.images:
            self.taken.append(_vector(self.space, self.action))
        self.images.append(_frame(image))
        parts: Any = observation if isinstance(observation, dict) else {OBSERVATION: observation}
        for name, value in parts.items():
            if isinstance(value, str):
                self.said.setdefault(name, []).append(value)
        self.seen.append(np.array(observation))

    def recording(self, space: Any) -> Recording:
        """All that was kept; observations are a state if their `space` is one of vectors.

        Raises:
            DataError: there is no second frame, or frames are of several sizes.
        """
        shapes = [image.shape[:2] for image in self.images]
        if other := next((shape for shape in shapes if shape != shapes[0]), None):
            first, then = ("×".join(map(str, shape)) for shape in (shapes[0], other))
            raise DataError(
                f"its render() returns frames of {first} first and of {then} in frame "
                f"{shapes.index(other)}: wrap it in one that renders one size"
            )
        vectors = isinstance(space, Box) and len(space.shape) == 1
        states = {OBSERVATION: np.stack(self.seen)} if vectors else {}
        if not self.taken:
            raise DataError("it ends before a second frame is shown")
        frames, facts = np.stack(self.images), text_facts(self.said)
        return Recording(frames, np.stack(self.taken), states, facts=facts)


def play(
    stage: Stage, policy: Policy | None, specs: Sequence[EpisodeSpec], frames: int
) -> list[Take]:
    """Play one episode in each environment, up to its end or to `frames` frames.

    Nothing is kept of the episodes that an environment begins by itself after that.

    Args:
        stage: the environments.
        policy: who acts; None samples actions.
        specs: as many as there are environments; they seed starts and policies.
        frames: most frames of an episode.
    """
    takes = list(_takes(stage, policy, specs, frames))
    seen = stage.reset([int(spec.rng("reset").integers(2**31)) for spec in specs])
    for take, observation, image in zip(takes, seen, _rendered(stage), strict=True):
        take.show(observation, image)
    while not all(take.ended for take in takes):
        actions = [take.act(observation) for take, observation in zip(takes, seen, strict=True)]
        seen, ends = stage.step(actions)
        for take, observation, end, image in zip(takes, seen, ends, _rendered(stage), strict=True):
            if not take.ended and (stage.shows_last or not end):
                take.show(observation, image)
            take.ended |= bool(end) or len(take.images) >= take.limit
    return takes


def _takes(
    stage: Stage, policy: Policy | None, specs: Sequence[EpisodeSpec], frames: int
) -> Iterator[Take]:
    for spec in specs:
        rng, space = spec.rng("policy"), copy.deepcopy(stage.action_space)
        space.seed(int(rng.integers(2**31)))
        yield Take(policy, space, rng, frames)


_OPENGL = re.compile(r"opengl|glfw|gladload|\begl|osmesa|DISPLAY env|X11|NoSuchDisplay", re.I)
"""What errors of OpenGL's libraries name, if there is no display."""


def _rendered(stage: Stage) -> Sequence[Any]:
    try:
        with warnings.catch_warnings():  # GLFW says several times what the error says, too
            warnings.filterwarnings("ignore", category=Warning, module="glfw")
            return stage.render()
    except DataError:
        raise
    except Exception as error:  # e.g. OpenGL or a drawing library is missing
        reason = f"{type(error).__name__}: {error}"
        if _OPENGL.search(reason):
            raise DataError(
                "the environment draws with OpenGL, but there is no display: set MUJOCO_GL=egl "
                "(with "
                "a GPU) or MUJOCO_GL=osmesa, or put xvfb-run before the command"
            ) from error
        raise DataError(f"the environment cannot be rendered ({reason})") from error


def _vector(space: Any, action: Any) -> NDArray[np.float32]:
    if isinstance(space, Discrete):
        return np.eye(int(space.n), dtype=np.float32)[int(action) - int(space.start)]
    return np.array(action, np.float32).reshape(-1)


def _frame(image: Any) -> NDArray[np.uint8]:
    frame = np.array(image)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise DataError("its render() returns no uint8 frame [H, W, 3]")
    return frame
