"""Planning with the true simulator: candidates are simulated from the current moment."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.environment import Environment
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.env.task import Frame, observed
from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.codec import Codec
from acwm_core.model.dynamics import Keypoints
from acwm_core.model.shapes import Actions, Latent, Video
from acwm_planning.futures import GoalCost, History, still_latent
from acwm_planning.planner import Futures, RolloutCost


class SimulatorFutures(Futures):
    """The real futures of candidates.

    Each candidate starts from a snapshot of the current moment if the environment can take one.
    Otherwise it costs a reset and all actions since the start. Only requested frames are rendered.

    Args:
        environment: a second environment of the same kind, not the one of the running episode.
        history: history of the episode.
        actions: candidates, `[N, T, A]`.
        stride: number of actions per latent frame.
        codec: encodes frames as latents, as if they stood still; None if no latents are needed.
        estimator: with it, states are read from the codec's reconstructions of the frames, which
            shows what codec and estimator alone lose. Without it, states are the true ones.
        reads: where a model sees things in latent frames, for costs that compare these.
    """

    def __init__(
        self,
        environment: Environment,
        history: History,
        actions: Actions,
        stride: int,
        codec: Codec | None,
        estimator: StateEstimator | None = None,
        reads: Callable[[Latent], Keypoints] | None = None,
    ) -> None:
        self._environment, self._history, self._codec = environment, history, codec
        self._estimator, self._reads = estimator, reads
        self._actions = actions.detach().cpu().numpy()
        self._ends = [*range(stride, actions.shape[1], stride), actions.shape[1]]
        self.length = len(self._ends)
        self._observations: dict[tuple[int, ...], tuple[list[Frame], Observation]] = {}
        self._restore: Callable[[], None] | None = None

    @property
    def encoding(self) -> str:
        """That of the codec, if there is one."""
        return "" if self._codec is None else self._codec.latents_fingerprint()

    def latents(self, frames: Sequence[int]) -> Latent:
        pictures = self._simulate(frames)[0]
        latents = torch.cat([self.still(picture) for picture in pictures])
        return latents.unflatten(0, (len(self._actions), -1)).squeeze(2)

    def video(self, frames: Sequence[int]) -> Video:
        pictures = as_clip(np.stack(self._simulate(frames)[0]))
        return pictures.unflatten(0, (len(self._actions), -1))

    def observe(self, frames: Sequence[int]) -> Observation:
        pictures, observation = self._simulate(frames)
        if self._estimator is None or self._codec is None:
            return observation
        latents = torch.cat([self.still(picture) for picture in pictures])
        with torch.no_grad():
            reconstructions = self._codec.decode(latents.expand(-1, 2, -1, -1, -1))[:, -1]
        return self._estimator.read(reconstructions.cpu())

    def predicted(self, frames: Sequence[int]) -> Observation:
        return self.observe(frames)

    def keypoints(self, frames: Sequence[int]) -> Keypoints | None:
        return None if self._reads is None else self._read(self.latents(frames))

    def keypoints_of(self, picture: Frame) -> Keypoints | None:
        return None if self._reads is None else self._read(self.still(picture))

    @torch.no_grad()
    def _read(self, latents: Latent) -> Keypoints:
        assert self._reads is not None
        return self._reads(latents)

    def still(self, picture: Frame) -> Latent:
        if self._codec is None:
            raise RecipeError("the simulator has no latents: take cost=state")
        device = next((weight.device for weight in self._codec.parameters()), torch.device("cpu"))
        return still_latent(self._codec, picture, device)

    def _simulate(self, frames: Sequence[int]) -> tuple[list[Frame], Observation]:
        key = tuple(frames)
        if key not in self._observations:
            results = [pair for rows in self._actions for pair in self._observe(rows, key)]
            infos = [info for _, info in results]
            self._observations[key] = [frame for frame, _ in results], observed(infos)
        return self._observations[key]

    def _observe(self, actions: NDArray[np.float32], frames: Sequence[int]):
        """Frame and info at each of these latent frames, in order."""
        environment, step = self._environment, 0
        self._start()
        for frame in frames:
            for action in actions[step : self._ends[frame]]:
                environment.advance(action)
            step = self._ends[frame]
            yield environment.observe()

    def _start(self) -> None:
        """Bring the environment to the end of the history."""
        if self._restore is not None:
            self._restore()
            return
        self._environment.reset(options={"spec": self._history.spec})
        for action in self._history.actions:
            self._environment.advance(action)
        self._restore = self._environment.snapshot()


class SimulatorRollouts:
    """Computes the futures of candidates with the simulator, in place of `ModelRollouts`.

    Args:
        environment: an environment for its own use.
        stride: number of actions between two frames that costs may look at.
        codec: codec of the latents, if a cost needs them.
        estimator: see `SimulatorFutures`.
        reads: see `SimulatorFutures`.
    """

    def __init__(
        self,
        environment: Environment,
        stride: int,
        codec: Codec | None = None,
        estimator: StateEstimator | None = None,
        reads: Callable[[Latent], Keypoints] | None = None,
    ) -> None:
        self.environment, self._stride, self._codec = environment, stride, codec
        self._estimator, self._reads = estimator, reads

    def cost(
        self, history: History, still: NDArray[np.float32], goal_cost: GoalCost, seed: int
    ) -> RolloutCost:
        """As `ModelRollouts.cost`; `still` and `seed` are ignored here."""

        def cost(actions: Actions) -> Tensor:
            futures = SimulatorFutures(
                *(self.environment, history, actions, self._stride, self._codec),
                *(self._estimator, self._reads),
            )
            return goal_cost(futures, len(actions))

        return cost
