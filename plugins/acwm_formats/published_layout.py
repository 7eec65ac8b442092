"""The layout of the published ACWM-Phys release (arXiv:2605.08567): names, folders, metadata.

ROOT/CATEGORY/ENVIRONMENT/{ind_train,ind_test,ood_test}/episode_{i}.mp4
                                                        metadata.pt

``metadata.pt`` is read without executing pickled code in it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.episode import Split
from acwm_core.errors import DataError
from acwm_core.files import load_plain

CITATION = "ACWM-Phys, arXiv:2605.08567"
METADATA = "metadata.pt"
PARTS = "metadata_part_*.pt"

FOLDERS: dict[str, Split] = {
    "ind_train": "train",
    "ind_test": "ind_test",
    "ood_test": "ood_test",
}
"""The folder of each split."""

PLACES = {
    "push_cube": ("rigid_dynamics", "push_block"),
    "push_cube_two_pushers": ("rigid_dynamics", "pushcube_2"),
    "stack_cube": ("rigid_dynamics", "stack_cube"),
    "push_rope": ("deformable", "push_rope"),
    "cloth_move": ("deformable", "clothmove"),
    "push_sand": ("particle", "push_sand"),
    "pour_water": ("particle", "pour_water"),
    "robot_arm": ("kinematics", "robot_arm_64"),
    "reacher": ("kinematics", "reacher"),
}
"""Category and folder of an environment, by its name in acwm."""

ENVIRONMENTS = {folder: name for name, (_, folder) in PLACES.items()}
"""The name of an environment in acwm, by its folder."""


class EpisodeMetadata(NamedTuple):
    """The metadata of one episode.

    Attributes:
        video: file name of its video.
        actions: ``[T, A]`` float32.
        length: stated number of frames.
    """

    video: str
    actions: NDArray[np.float32]
    length: int


def read_entries(path: Path) -> list[EpisodeMetadata]:
    """Read the entries of a ``metadata.pt``, a list of dicts saved by `torch.save`.

    Raises:
        DataError: it is missing or damaged, holds code, or has unexpected content.
    """
    content = load_plain(path)
    if not isinstance(content, list) or not content:
        raise DataError(f"{path} holds no list of episodes")
    values = cast(list[Any], content)
    return [_entry(f"episode {i} of {path}", value, i) for i, value in enumerate(values)]


def _entry(what: str, value: object, index: int) -> EpisodeMetadata:
    if not isinstance(value, Mapping):
        raise DataError(f"{what} is not a dict")
    fields = cast(Mapping[Any, Any], value)
    actions = _numbers(fields.get("actions"))
    if actions is None:
        raise DataError(f"{what} has no actions [T, A] of floating-point numbers")
    if not np.all(np.isfinite(actions)):
        raise DataError(f"{what} has an action that is not finite")
    # Paths may come from another machine or operating system: only the file name counts.
    name = re.split(r"[\\/]", str(fields.get("video_path") or f"episode_{index}.mp4"))[-1]
    if name in ("", ".", ".."):
        raise DataError(f"{what} names no video")
    length = fields.get("length", len(actions))
    if isinstance(length, np.integer):
        length = int(cast(Any, length))
    if not isinstance(length, int) or length < 0:
        raise DataError(f"{what} has the length {length!r}")
    return EpisodeMetadata(name, actions, length)


def _numbers(value: object) -> NDArray[np.float32] | None:
    """A float32 matrix from floating-point numbers of any precision; None if it is not a matrix."""
    if isinstance(value, torch.Tensor) and value.layout == torch.strided:
        value = value.to(torch.float32).numpy() if value.is_floating_point() else None
    if not isinstance(value, np.ndarray):
        return None
    array = cast(NDArray[Any], value)
    return array.astype(np.float32) if array.ndim == 2 and array.dtype.kind == "f" else None
