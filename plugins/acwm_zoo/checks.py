"""Checks of a checkpoint importer: what `acwm import-checkpoint` requires of it."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

import torch
from torch import Tensor

from acwm_core.checks.result import Suite, expect, expect_is_a
from acwm_core.errors import DataError
from acwm_zoo.importer import CheckpointImporter, ForeignModel, convert, recipe_of

STRANGERS: tuple[dict[str, Any], ...] = (
    {},
    {"step": 3},
    {"weight": torch.zeros(2)},
    {"model_state_dict": {"weight": torch.zeros(2)}, "optimizer_state_dict": {}},
    {"model_state_dict": torch.zeros(2), "state_dict": [1, 2], "model": None},
)
"""Contents of other formats, or of no known format."""

Path = tuple[str, ...]
"""Keys that lead to a tensor in nested dicts."""

Change = Callable[[Tensor], Tensor | None]
"""Changes a tensor; if it returns None, the tensor is left out."""


class ImporterChecks(Suite):
    """Checks of an `acwm_zoo.importer.CheckpointImporter` on its own example."""

    kind = "importer"

    @functools.cached_property
    def _importer(self) -> CheckpointImporter:
        return self.make()

    @functools.cached_property
    def _example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        return self._importer.example()

    def _converted(self, change: Change, *paths: Path) -> dict[str, Tensor]:
        content, overrides = self._example
        for path in paths:
            content = _changed(content, path, change)
        found = self._importer.read(content)
        expect_is_a(found, ForeignModel)
        assert found is not None
        return convert(found, recipe_of(found, overrides))

    @functools.cached_property
    def _whole(self) -> dict[str, Tensor]:
        return self._converted(_moved)

    @functools.cached_property
    def _needed(self) -> list[Path]:
        """Paths of the tensors that the import uses: without them it changes or fails."""
        return [path for path in _tensors(self._example[0]) if self._is_needed(path)]

    def _is_needed(self, path: Path) -> bool:
        try:
            found = self._converted(_moved, path)
        except DataError:
            return True
        return any(not torch.equal(found[name], tensor) for name, tensor in self._whole.items())

    def reads_its_example(self) -> None:
        """Read the example as a model with a valid recipe, and convert its weights, all finite."""
        expect_is_a(self._importer, CheckpointImporter)
        expect(self._whole, "its model has no weights")

    def leaves_other_content_alone(self) -> None:
        """Return None for content of another format."""
        for content in STRANGERS:
            found = self._importer.read(content)
            expect(found is None, f"it takes {content!r:.60} for its format")

    def uses_every_weight(self) -> None:
        """Let every weight of model and conditioner come from the checkpoint."""
        moved = self._converted(_moved, *self._needed)
        same = [name for name, tensor in self._whole.items() if torch.equal(tensor, moved[name])]
        expect(not same, f"{', '.join(same[:3])} does not depend on the checkpoint")

    def names_what_is_missing(self) -> None:
        """Refuse a checkpoint that lacks a tensor, with a `DataError` that names it."""
        self._expect_named(lambda tensor: None, "lacks")

    def names_what_has_another_shape(self) -> None:
        """Refuse a tensor with an extra axis, with a `DataError` that names it."""
        self._expect_named(lambda tensor: tensor[None], "has another shape of")

    def _expect_named(self, change: Change, what: str) -> None:
        for path in self._needed:
            name = path[-1]
            try:
                self._converted(change, path)
            except DataError as error:
                words = re.findall(r"[\w.]+\w", str(error))
                named = any(name.endswith(word) and "." in word for word in words)
                expect(named, f"{error}: no {name}")
            else:
                expect(False, f"a checkpoint that {what} {name} is taken")


def _moved(tensor: Tensor) -> Tensor:
    return tensor + 1


def _tensors(content: Mapping[str, Any], above: Path = ()) -> Iterator[Path]:
    for key, value in content.items():
        if isinstance(value, Tensor):
            yield (*above, key)
        elif isinstance(value, Mapping):
            yield from _tensors(cast(Mapping[str, Any], value), (*above, key))


def _changed(content: Mapping[str, Any], path: Path, change: Change) -> dict[str, Any]:
    copy = dict(content)
    key, *below = path
    value = _changed(copy[key], tuple(below), change) if below else change(copy.pop(key))
    return copy if value is None else {**copy, key: value}


check_importer = ImporterChecks.check
