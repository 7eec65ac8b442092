"""The states that a model predicts of candidates, without a picture."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from acwm_core.model.codec import Codec
from acwm_core.model.dynamics import Predictor
from acwm_core.model.shapes import Actions, Latent, Video
from acwm_core.model.state_stream import StateStream
from acwm_core.model.stream import continued
from acwm_core.model.world_model import WorldModel


class Given(NamedTuple):
    """What a decision knows.

    Attributes:
        codec: of the latents, with the last given frame as its reference.
        video: the given frames, `[1, K, 3, H, W]`.
        latents: the given latent frames, `[1, …]`.
        actions: raw actions from the first given frame to now, `[1, N, A]`.
    """

    codec: Codec
    video: Video
    latents: Latent
    actions: Tensor

    @property
    def frames(self) -> int:
        """Number of video frames from the first given one to the current one."""
        return 1 + self.actions.shape[1]


class CandidateStates:
    """Predicts the states of the candidates of one decision.

    What happened before the plan is predicted once for all candidates, and of the states only what
    the fields that are asked for need.

    Args:
        world: the world model.
        given: what the decision knows.
        seed: of the noise that all candidates share.
        asked: names of the fields that earlier decisions were asked for; others are added.
        whole: predicts all states `[N, T, S]` after the given frames, for a model that cannot carry
            them on from frame to frame.
    """

    def __init__(
        self,
        world: WorldModel,
        given: Given,
        seed: int,
        asked: set[str],
        whole: Callable[[Actions], Tensor],
    ) -> None:
        self._world, self._given, self._seed, self._whole = world, given, seed, whole
        self._asked, self._stride = asked, world.codec.temporal_stride
        self._now: StateStream | None = None

    def __call__(self, actions: Actions, field: str) -> dict[str, Tensor]:
        """The fields asked for so far, and this one, of candidates `[N, T, A]`.

        Returns:
            By name, `[N, frames, …]`; whole latent frames, so they may go on after the plan.
        """
        if field not in self._asked:
            self._asked.add(field)
            self._now = None
        model = self._world.model
        carries = isinstance(model, Predictor) and model.implements("carry_states")
        if not carries or self._world.conditioner.history is None:
            planned = self._whole(actions)[:, self._given.frames - self._given.video.shape[1] :]
            return self._world.named_states(planned)
        self._now = now = self._now or self._carried_on()
        stream = now.picked(torch.zeros(len(actions), dtype=torch.long))
        rows = continued(actions.detach(), -actions.shape[1] % self._stride)
        steps = [stream.step(step) for step in self._on_device(rows).split(self._stride, 1)]
        return {name: torch.cat([step[name] for step in steps], 1) for name in self._asked}

    def _carried_on(self) -> StateStream:
        """What was asked for as it is now, from the given frames and what was done since."""
        given, between = self._given, self._given.video.shape[1] - 1
        actions = self._on_device(given.actions)
        begun = self._world.stream_states(given.video, actions[:, :between], seeds=[self._seed])
        stream = begun.only(self._asked)
        for step in actions[:, between:].split(self._stride, 1):
            if step.shape[1]:
                stream.step(step)
        return stream

    def _on_device(self, actions: Tensor) -> Tensor:
        return actions.to(self._world.device)
