"""`check_importer`: what `acwm import-checkpoint` relies on in an importer."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

import torch
from torch import Tensor

from acwm_core.checks.result import (
    CheckFailure,
    CheckResult,
    expect,
    expect_is_a,
    factory,
    run_checks,
)
from acwm_core.errors import CheckpointError
from acwm_core.importer import CheckpointImporter, ForeignModel
from acwm_core.training.import_checkpoint import convert, recipe_of

STRANGERS: tuple[dict[str, Any], ...] = (
    {},
    {"step": 3},
    {"weight": torch.zeros(2)},
    {"model_state_dict": {"weight": torch.zeros(2)}, "optimizer_state_dict": {}},
    {"model_state_dict": torch.zeros(2), "state_dict": [1, 2], "model": None},
)
"""Contents of other formats, or of none."""

Path = tuple[str, ...]
"""Keys that lead to a tensor in nested dicts."""


class ImporterTrial:
    """An importer and its example.

    Args:
        make: constructs the importer.
    """

    def __init__(self, make: Callable[..., CheckpointImporter]) -> None:
        self.make = make

    @functools.cached_property
    def importer(self) -> CheckpointImporter:
        """One instance."""
        return self.make()

    @functools.cached_property
    def example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Its example."""
        return self.importer.example()

    def converted(self, content: Mapping[str, Any]) -> dict[str, Tensor]:
        """The weights that come of a content."""
        found = self.importer.read(content)
        expect_is_a(found, ForeignModel)
        assert found is not None
        return convert(found, recipe_of(found, self.example[1]))

    def changed(self, path: Path, change: Callable[[Tensor], Tensor | None]) -> dict[str, Any]:
        """The example with one tensor changed, or left out."""
        return _changed(self.example[0], path, change)

    @functools.cached_property
    def needed(self) -> list[Path]:
        """Where the tensors are that the import uses: without them it is another or none."""
        whole = self.converted(self.example[0])
        return [path for path in _tensors(self.example[0]) if self._is_needed(path, whole)]

    def _is_needed(self, path: Path, whole: Mapping[str, Tensor]) -> bool:
        try:
            found = self.converted(self.changed(path, lambda tensor: tensor + 1))
        except CheckpointError:
            return True
        return any(not torch.equal(found[name], tensor) for name, tensor in whole.items())


def check_importer(importer: str | Callable[..., CheckpointImporter]) -> Iterator[CheckResult]:
    """Check an importer against the contract of `acwm_core.importer.CheckpointImporter`.

    Args:
        importer: a registered name, or the class.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    return run_checks(CHECKS, ImporterTrial(factory("importer", importer)))


def reads_its_example(trial: ImporterTrial) -> None:
    """Read the example as a model of a valid recipe, and convert its weights, which are finite."""
    expect_is_a(trial.importer, CheckpointImporter)
    trial.converted(trial.example[0])


def leaves_other_content_alone(trial: ImporterTrial) -> None:
    """Return None for what is of another format."""
    for content in STRANGERS:
        found = trial.importer.read(content)
        expect(found is None, f"it takes {content!r:.60} for its format")


def uses_every_weight(trial: ImporterTrial) -> None:
    """Let every weight of model and conditioner come from the checkpoint."""
    whole = trial.converted(trial.example[0])
    content = trial.example[0]
    for path in trial.needed:
        content = _changed(content, path, lambda tensor: tensor + 1)
    moved = trial.converted(content)
    same = [name for name, tensor in whole.items() if torch.equal(tensor, moved[name])]
    expect(not same, f"{', '.join(same[:3])} does not depend on the checkpoint")


def names_what_is_missing(trial: ImporterTrial) -> None:
    """Refuse a checkpoint that lacks a tensor by a `CheckpointError` with its name."""
    for path in trial.needed:
        _expect_named(trial, path, trial.changed(path, lambda tensor: None), "lacks")


def names_what_has_another_shape(trial: ImporterTrial) -> None:
    """Refuse a tensor with an axis too many by a `CheckpointError` with its name."""
    for path in trial.needed:
        _expect_named(trial, path, trial.changed(path, lambda t: t[None]), "has another shape of")


def _expect_named(trial: ImporterTrial, path: Path, content: dict[str, Any], what: str) -> None:
    name = path[-1]
    try:
        trial.converted(content)
    except CheckpointError as error:
        words = re.findall(r"[\w.]+\w", str(error))
        expect(any(name.endswith(word) and "." in word for word in words), f"{error}: no {name}")
        return
    except CheckFailure:
        raise CheckFailure(f"it does not know its own format by what {what} {name}") from None
    raise CheckFailure(f"a checkpoint that {what} {name} is taken")


def _tensors(content: Mapping[str, Any], above: Path = ()) -> Iterator[Path]:
    for key, value in content.items():
        if isinstance(value, Tensor):
            yield (*above, key)
        elif isinstance(value, Mapping):
            yield from _tensors(cast(Mapping[str, Any], value), (*above, key))


def _changed(
    content: Mapping[str, Any], path: Path, change: Callable[[Tensor], Tensor | None]
) -> dict[str, Any]:
    copy = dict(content)
    key, *below = path
    value = _changed(copy[key], tuple(below), change) if below else change(copy[key])
    if value is None:
        del copy[key]
    else:
        copy[key] = value
    return copy


CHECKS = (
    reads_its_example,
    leaves_other_content_alone,
    uses_every_weight,
    names_what_is_missing,
    names_what_has_another_shape,
)
