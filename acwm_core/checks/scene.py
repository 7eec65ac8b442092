"""Whether what a card declares of the scene is true of an episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import EnvironmentCard
from acwm_core.env.episode import Episode
from acwm_core.env.state_field import PLACES, Part, StateField
from acwm_core.env.states import encode, rows_of

UNIT = 1e-3
"""By how much the length of a quaternion may differ from 1."""

STEEP, SLACK = 20.0, 0.05
"""How fast a field may change with those it follows from, and by how much without: both in terms of
how far they are spread over the episode."""

AWAY, MOSTLY, EVERY = 0.1, 0.75, 4
"""How far in frame heights a position may appear from the nearest pixel of its instance, and in
which share of the cases, as others may cover it; every n-th frame is examined."""

Array = NDArray[np.float64]


def wrong_numbers(field: StateField, episode: Episode) -> str:
    """What in an episode cannot be of the kind that is declared; empty if nothing."""
    rows = rows_of(field, np.asarray(episode.states[field.name], np.float64))
    there = _there(field, episode)
    for part in field.parts:
        values = _of(part, rows)
        if part.kind == "presence" and not np.isin(values, (0, 1)).all():
            return f"{field.name!r} is a presence and not always 0 or 1"
        if part.kind == "quaternion":
            off = np.abs(np.linalg.norm(values, axis=-1) - 1)[there]
            if off.max(initial=0) > UNIT:
                return f"{field.name!r} is a quaternion and not always of length 1"
    return ""


def wrongly_following(field: StateField, sources: Sequence[StateField], episode: Episode) -> str:
    """Whether a field is no function of its sources in an episode; empty if it may be one.

    Of any two frames in which the sources are alike, the field must be alike, too: its distance may
    be a multiple of theirs, but where they stand still it may not move.
    """
    ours = _distances([field], episode)
    theirs = _distances(sources, episode)
    if (ours <= STEEP * theirs + SLACK).all():
        return ""
    first, second = np.unravel_index((ours - STEEP * theirs).argmax(), ours.shape)
    names = ", ".join(source.name for source in sources)
    return (
        f"{field.name!r} does not follow from {names}: they hardly differ in frames {first} and "
        f"{second}, and it does"
    )


def wrongly_seen(field: StateField, card: EnvironmentCard, episode: Episode) -> str:
    """Whether the masks show an instance elsewhere than its positions are; empty if not."""
    far = [d for part in field.parts for d in _from_masks(field, part, card, episode)]
    if not far or np.mean(np.array(far) <= AWAY) >= MOSTLY:
        return ""
    return (
        f"{field.name!r} appears {np.median(far):.0%} of the frame's height away from the masks of "
        f"{', '.join(dict.fromkeys(field.instances))}: the camera or the instances are others"
    )


def _from_masks(
    field: StateField, part: Part, card: EnvironmentCard, episode: Episode
) -> Iterator[float]:
    """How far in frame heights positions in view appear from pixels of their instance."""
    if part.kind not in PLACES or card.camera is None or not field.instances:
        return
    height, width = card.frame_size
    places = _of(part, rows_of(field, np.asarray(episode.states[field.name], np.float64)))
    if places.shape[-1] == 2:
        places = np.concatenate([places, np.full_like(places[..., :1], field.height)], -1)
    seen, there = card.camera.project(places, height, width), _there(field, episode)
    inside = ((seen > 0) & (seen < [width, height, np.inf])).all(-1) & there
    for frame in range(0, len(seen), EVERY):
        for name in dict.fromkeys(field.owners):
            own = np.argwhere(episode.masks[frame] == card.instances.index(name))[:, ::-1] + 0.5
            rows = inside[frame] & (np.array(field.owners) == name)
            if len(own) and rows.any():
                apart = seen[frame, rows, None, :2] - own
                yield from np.linalg.norm(apart, axis=-1).min(1) / height


def _of(part: Part, rows: Array) -> Array:
    return rows[..., list(part.columns)] if part.columns else rows


def _there(field: StateField, episode: Episode) -> NDArray[np.bool_]:
    """Which rows of a field exist, ``[T, rows]``."""
    if not field.present:
        return np.ones((len(episode.video), field.rows), np.bool_)
    return np.asarray(episode.states[field.present]).reshape(-1, field.rows) > 0


def _distances(fields: Sequence[StateField], episode: Episode) -> Array:
    """How different frames are in some fields, ``[T, T]``, relative to how these are spread."""
    distances = np.zeros((len(episode.video),) * 2)
    for field in fields:
        code = encode(field, np.asarray(episode.states[field.name], np.float64))
        code = code.reshape(len(code), -1)
        spread = np.sqrt(((code - code.mean(0)) ** 2).sum(1).mean())
        if spread > UNIT * np.abs(code).max(initial=0):
            distances += (((code[:, None] - code[None]) / spread) ** 2).sum(-1)
    return np.sqrt(distances)
