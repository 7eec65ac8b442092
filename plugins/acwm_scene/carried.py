"""What is carried from frame to frame of a scene: all that drawing needs, or the states alone."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import CarriedStates, Keypoints, LatentStream
from acwm_core.model.shapes import Latent
from acwm_scene.group import tree_map

if TYPE_CHECKING:
    from acwm_scene.scene import Scene, SceneDynamics


class SceneStream(LatentStream):
    """A stream that carries the scene."""

    def __init__(self, model: SceneDynamics, scene: Scene) -> None:
        self._model, self._scene = model, scene

    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame; see `LatentStream.advance`."""
        latent, self._scene = self._model.next_frame(self._scene, conditioning)
        return latent

    def keypoints(self) -> Keypoints | None:
        """The learnt points; what is declared cannot be moved."""
        points = self._model.points
        if points is None:
            return None
        return points.keypoints(points.frame(self._scene.states["points"])[:, None], 1.0)

    def move_keypoint(self, number: int, place: Tensor) -> None:
        """See `LatentStream.move_keypoint`."""
        assert self._model.points is not None
        moved = self._model.points.moved_to(self._scene.states["points"], number, place)
        self._scene = self._scene._replace(states=self._scene.states | {"points": moved})


class SceneStates(CarriedStates):
    """The states of scenes, without what drawing them needs."""

    def __init__(
        self, model: SceneDynamics, states: dict[str, Any], agents_of: str | None = None
    ) -> None:
        self._model, self._states, self._agents_of = model, states, agents_of

    @property
    def current(self) -> Tensor:
        states = self._model.states_of(self._states)
        if self._agents_of:
            known = self._model.agent_columns(self._agents_of)
            states = torch.full_like(states, math.nan).index_copy(1, known, states[:, known])
        return states

    def advance(self, conditioning: Conditioning) -> Tensor:
        actions = {name: rows[:, -1] for name, rows in self._model.embed(conditioning).items()}
        if self._agents_of:
            self._states, states = self._model.move_agents(self._states, actions, self._agents_of)
            return states
        self._states, courses = self._model.move_states(self._states, actions)
        return self._model.decode(courses)

    def picked(self, rows: Tensor) -> CarriedStates:
        copied = tree_map(lambda values: values[rows.to(values.device)].clone(), self._states)
        return SceneStates(self._model, copied, self._agents_of)

    def only(self, columns: Collection[int]) -> CarriedStates:
        return SceneStates(self._model, self._states, self._model.agents_of(columns))

    def put(self, rows: Tensor, others: CarriedStates) -> None:
        assert isinstance(others, SceneStates)
        self._states = tree_map(
            lambda own, new: own.index_copy(0, rows.to(own.device), new.to(own)),
            self._states,
            others._states,
        )
