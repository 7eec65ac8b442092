"""A recorded episode, whatever it was recorded with, and the `Episode` that is made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.check import InvalidDataError, check_episode
from acwm_core.data.exchange.area import shrunk
from acwm_core.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.episode import Episode, EpisodeSpec
from acwm_core.errors import DataError

INSTANCES = ("unlabelled",)
"""The one instance of recorded masks: every pixel has id 0."""

UNSEEN = "Recorded: without instance masks (all zero) and contacts (none)."


@dataclass(frozen=True)
class Recording:
    """What a recorder saw of one episode.

    The arrays may differ in length: what all of them span is kept.

    Attributes:
        video: ``[T, H, W, 3]`` uint8.
        actions: ``[T, A]`` or ``[T − 1, A]``; row i takes frame i to i + 1, so that a T-th row
            leads to no frame and is not kept.
        states: arrays of numbers by name, each ``[T, …]``.
    """

    video: NDArray[np.uint8]
    actions: NDArray[np.floating[Any]]
    states: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])

    @property
    def frames(self) -> int:
        """How many frames all arrays span."""
        return min([len(self.video), len(self.actions) + 1, *map(len, self.states.values())])


def recorded_card(
    name: str,
    action: ActionSpec,
    *,
    frame_size: tuple[int, int],
    fps: int,
    horizon: int,
    state: Sequence[StateField] = (),
    summary: str = "",
    engine: str = "recorded",
    citation: str = "",
) -> EnvironmentCard:
    """The environment card of recorded data: no factors, one instance, no simulator."""
    return EnvironmentCard(
        name=name,
        summary=f"{summary.removesuffix(UNSEEN).rstrip('. ')}. {UNSEEN}".removeprefix(". "),
        action=action,
        frame_size=frame_size,
        fps=fps,
        horizon=horizon,
        factors=(),
        ood_shifts=(),
        state=tuple(state),
        instances=INSTANCES,
        engine=engine,
        citation=citation,
    )


def recorded_episode(recording: Recording, spec: EpisodeSpec, card: EnvironmentCard) -> Episode:
    """The `Episode` of a recording, with frames of the card's size.

    Raises:
        DataError: it has less than two frames, or is not what the card says.
    """
    frames = recording.frames
    if frames < 2:
        raise DataError(f"it has {frames} usable frames, and an action leads from one to another")
    video = np.asarray(recording.video[:frames])
    if video.dtype != np.uint8 or video.ndim != 4 or video.shape[3] != 3:
        raise DataError(f"video is {video.dtype} {video.shape}, not uint8 [T, H, W, 3]")
    actions = np.zeros((frames, card.action.size), np.float32)
    given = np.asarray(recording.actions)
    if given.ndim != 2 or given.shape[1] != card.action.size:
        raise DataError(f"actions are {given.shape}, not [T, {card.action.size}]")
    actions[:-1] = given[: frames - 1]
    episode = Episode(
        spec=spec,
        video=shrunk(video, card.frame_size),
        actions=actions,
        states={name: np.asarray(rows[:frames]) for name, rows in recording.states.items()},
        masks=np.zeros((frames, *card.frame_size), np.uint8),
        contacts=np.zeros((0, 3), np.int32),
        factors={},
        ood_label=None,
    )
    try:
        check_episode(episode, card)
    except InvalidDataError as problem:
        raise DataError(str(problem)) from None
    return episode
