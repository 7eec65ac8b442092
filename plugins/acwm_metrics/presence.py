"""Whether objects in a video are there, each once, as objects must be."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from acwm_core.metric import Rollout
from acwm_metrics.physical import instance_id, physics_of
from acwm_metrics.shape import counts

MIN_SHARE = 0.2
"""Share of an object's usual area below which it is not seen, and a part of it is none."""

COVERED = 0.3
"""Share of the place where an object was last seen that must be behind others to excuse it."""

MOSTLY = 0.5
"""Less than this share of its usual area was last seen of what is carried out of sight."""

Mask = NDArray[np.bool_]

_NEIGHBOURS = np.ones((3, 3), np.int64)
_IN_FRAME = np.stack([0 * _NEIGHBOURS, _NEIGHBOURS, 0 * _NEIGHBOURS])


def seen_once(rollout: Rollout) -> Mask:
    """Whether all is there in each frame, `[T]`."""
    return rollout.once(seen_once, lambda: np.logical_and.reduce(list(presence(rollout).values())))


def presence(rollout: Rollout) -> dict[str, Mask]:
    """Whether each object is as it must be in each frame, `[T]`, by its name.

    An object that the episode has must be seen, in one piece, unless something is before it or it
    reaches beyond the frame; one that the episode does not have must not be seen.
    """
    physics, masks = physics_of(rollout), rollout.observed.masks
    ids, areas, sizes = _areas(rollout)
    before = np.array([*ids, *(instance_id(rollout, name) for name in physics.shapes)])
    exist = sizes > 0
    least = MIN_SHARE * np.where(exist, sizes, np.median(sizes[exist]) if exist.any() else np.inf)
    movable = {name for reading in physics.readings for name in reading.instances}
    found: dict[str, Mask] = {}
    for k, (name, instance) in enumerate(zip(physics.objects, ids, strict=True)):
        seen = areas[:, k] >= least[k]
        if exist[k]:
            others = before[before != instance]
            first = rollout.masks[0] == instance
            found[name] = seen | hidden(masks, int(instance), seen, others, first)
            if name in movable:
                much = MOSTLY * float(sizes[k])
                found[name] |= carried(masks, int(instance), seen, others, much)
            found[name] &= pieces(masks, int(instance), others, float(least[k])) <= 1
        else:
            found[name] = ~seen
    return found


def out_of_sight(rollout: Rollout) -> Mask:
    """Whether each object that the episode has is not seen, hidden or not, `[T, objects]`."""
    _, areas, sizes = _areas(rollout)
    return (areas < MIN_SHARE * sizes) & (sizes > 0)


def _areas(
    rollout: Rollout,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Of all objects: ids `[n]`, areas in the prediction `[T, n]` and usual ones `[n]`."""
    names = physics_of(rollout).objects
    ids = np.array([instance_id(rollout, name) for name in names])
    return rollout.once(
        _areas,
        lambda: (ids, counts(rollout.observed.masks, ids), usual_sizes(rollout.masks, ids)),
    )


def usual_sizes(masks: NDArray[np.uint8], ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """The median area of instances in the frames that show them, `[n]`; 0 if none does."""
    areas = counts(masks, ids)
    return np.array([np.median(a[a > 0]) if a.any() else 0.0 for a in areas.T])


def hidden(
    masks: NDArray[np.uint8],
    instance: int,
    seen: Mask,
    others: NDArray[np.int64],
    first: Mask,
) -> Mask:
    """Whether something is before an object that is not seen, `[T]`.

    It is, if it lies where the object was last seen, or beside what is left to see of it.

    Args:
        masks: `[T, H, W]`.
        instance: the object.
        seen: `[T]`, where enough of it is seen.
        others: ids of all that may be before it.
        first: `[H, W]`, the true mask of the object in the frame that was given.
    """
    found, last = np.zeros(len(masks), np.bool_), first
    for frame in np.flatnonzero(~seen):
        earlier = np.flatnonzero(seen[:frame])
        if len(earlier):
            last = masks[earlier[-1]] == instance
        cover = np.isin(masks[frame], others)
        left = np.asarray(ndimage.maximum_filter(masks[frame] == instance, 3), np.bool_)
        found[frame] = (cover & left).any() or cover[last].sum() >= COVERED * last.sum()
    return found


def carried(
    masks: NDArray[np.uint8], instance: int, seen: Mask, others: NDArray[np.int64], much: float
) -> Mask:
    """Whether an object that is not seen may move along behind what all but hid it, `[T]`.

    As a cube in a hand: it was last seen beside something that is still there, and less than
    `much` of it, in pixels. One that vanishes in full sight is not carried.
    """
    found = np.zeros(len(masks), np.bool_)
    for frame in np.flatnonzero(~seen):
        earlier = np.flatnonzero(seen[:frame])
        if not len(earlier):
            continue
        last = masks[earlier[-1]]
        own = last == instance
        if own.sum() < much:
            beside = np.asarray(ndimage.maximum_filter(own, 3), np.bool_) & ~own
            found[frame] = np.isin(masks[frame], np.intersect1d(last[beside], others)).any()
    return found


def pieces(
    masks: NDArray[np.uint8], instance: int, others: NDArray[np.int64], least: float
) -> NDArray[np.int64]:
    """Of how many parts an object is seen in each frame, `[T]`.

    Parts are at least `least` pixels large. They count as one if what is between them belongs to
    something that may be before the object, or if they meet beyond the border of the frame.
    """
    number = np.zeros(len(masks), np.int64)
    own = masks == instance
    if not own.any():
        return number
    box = _box(own.any(0))
    parts = connected(own[:, *box])
    sizes = np.bincount(parts.ravel())
    where = np.flatnonzero((sizes >= least) & (np.arange(len(sizes)) > 0))
    frame_of = np.zeros(len(sizes), np.int64)
    frame_of[parts.reshape(len(parts), -1)] = np.arange(len(parts))[:, None]
    np.add.at(number, frame_of[where], 1)
    for frame in np.flatnonzero(number > 1):
        cover = np.isin(masks[frame], np.append(others, instance))
        joined = connected(np.pad(cover, 1, constant_values=True)[None])[0, 1:-1, 1:-1]
        number[frame] = len(np.unique(joined[box][np.isin(parts[frame], where)]))
    return number


def _box(mask: Mask) -> tuple[slice, slice]:
    """The smallest part of a frame that holds all of a mask `[H, W]`."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def connected(mask: Mask) -> NDArray[np.int64]:
    """Numbers from 1 for the connected regions of every frame, `[T, H, W]`; 0 outside of them.

    What is at most two pixels apart is connected: thin things have gaps in small frames.
    """
    numbers, _ = cast(Any, ndimage.label(ndimage.maximum_filter(mask, (1, 3, 3)), _IN_FRAME))
    return numbers * mask
