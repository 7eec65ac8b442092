"""The `Recipe`: everything that defines an experiment, checked, with all defaults written out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

from acwm_core.recipe.check import check_names, validate
from acwm_core.recipe.compose import merge, read_layers
from acwm_core.recipe.sections import COMPONENTS
from acwm_core.recipe.text import dump
from acwm_core.recipe.trust import recipes_are_trusted, refuse_code

FREE_TO_CHANGE = (
    "data.batch_size",
    "data.workers",
    "evaluation.",
    "trainer.accelerator",
    "trainer.accumulate_grad_batches",
    "trainer.devices",
    "trainer.enable_progress_bar",
    "trainer.log_every_n_steps",
    "trainer.logger",
    "trainer.max_steps",
    "trainer.max_time",
    "trainer.num_nodes",
    "trainer.strategy",
    "training.activation_checkpointing",
    "training.checkpoint_every_n_steps",
    "training.compile",
    "training.cpu_threads",
    "training.validation_rollouts",
)
"""Parameters that may change when a run is resumed; any other would affect its loss curve.

The devices may change if an optimiser step takes as many clips as before, which `ClipData` checks.
"""

LONGEST_SHOWN = 60
"""Characters of a value that messages show."""


@dataclass(frozen=True)
class ComponentConfig:
    """A component chosen in a recipe: a registered name and all its parameters."""

    name: str
    params: dict[str, Any]


@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Attributes:
        env: the environment that the data came from; None accepts any data in ``data.path``.
        codec: the video autoencoder.
        model: the dynamics model.
        conditioner: how actions enter the model.
        objective: how the model learns and predicts.
        training: keyword arguments of `acwm_core.training.config.TrainingConfig`.
        data: keyword arguments of `acwm_core.data.clips.DataConfig`.
        evaluation: keyword arguments of `acwm_core.evaluation.config.EvaluationConfig`.
        trainer: keyword arguments of Lightning's `Trainer`; only those that were set.
    """

    env: ComponentConfig | None
    codec: ComponentConfig
    model: ComponentConfig
    conditioner: ComponentConfig
    objective: ComponentConfig
    training: dict[str, Any]
    data: dict[str, Any]
    evaluation: dict[str, Any]
    trainer: dict[str, Any]

    @classmethod
    def from_dict(cls, sections: Mapping[str, Any]) -> Recipe:
        """Check the sections of a recipe file and build a recipe from them."""
        checked: dict[str, Any] = {"env": None, **validate(sections)}
        for section in COMPONENTS:
            if params := checked[section]:
                checked[section] = ComponentConfig(params.pop("name"), params)
        return cls(**checked)

    @classmethod
    def from_yaml(cls, path: str | Path) -> Recipe:
        """Read a recipe file, e.g. the one saved in a run; nothing that it names is imported."""
        return compose(path, trusted=True)

    def to_dict(self) -> dict[str, Any]:
        """The sections of a recipe file, with values of plain JSON types."""
        sections: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, ComponentConfig):
                value = {"name": value.name, **value.params}
            if value is not None:
                sections[field.name] = value
        return cast(dict[str, Any], json.loads(json.dumps(sections, default=str)))  # str for paths

    def to_yaml(self) -> str:
        """The text of a complete recipe file; `from_yaml` reads it back."""
        return dump(self.to_dict())


def compose(
    recipe: str | Path,
    overrides: Sequence[str] = (),
    *,
    sections: Sequence[str] | None = None,
    trusted: bool | None = None,
) -> Recipe:
    """Read a recipe, apply overrides to it and check everything.

    Names, sections and the values of `training`, `data` and `evaluation` are checked first, at
    once; then the parameters of the components, which are imported for it.

    Args:
        recipe: a path, or the name of a packaged recipe such as ``push_cube_small``.
        overrides: ``conditioner=cross_attention``, ``model.layers=4``, ``trainer.devices=2`` …
        sections: the sections that will be used; all by default. In others, code may be named.
        trusted: whether code that the files name may be run; what `overrides` name always may. By
            default only if the command line said ``--trust-recipe``.

    Raises:
        RecipeError: a file, name, parameter or type is wrong; suggests the most similar one. Or
            the recipe names code that the overrides do not.
    """
    layers = read_layers(recipe, overrides)
    check_names(merge(*layers, quick=True))
    composed = merge(*layers)
    if not (recipes_are_trusted() if trusted is None else trusted):
        refuse_code(composed, overrides, sections, recipe)
    return Recipe.from_dict(composed)


def recipe_differences(before: Recipe, now: Recipe) -> list[str]:
    """What a resumed run would change, as phrases such as ``"model.layers was 4, is 6"``."""
    return [
        difference
        for difference in differences(before, now)
        if not difference.startswith(FREE_TO_CHANGE)
    ]


def differences(before: Recipe, now: Recipe, *, only_set: bool = False) -> list[str]:
    """The parameters that differ, as phrases such as ``"model.layers was 4, is 6"``.

    Args:
        only_set: leave out parameters that `now` does not set.
    """
    old, new = dict(flat_items(before.to_dict())), dict(flat_items(now.to_dict()))
    return [
        f"{name} was {_shown(old.get(name))}, is {_shown(new.get(name))}"
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name) and not (only_set and new.get(name) is None)
    ]


def _shown(value: Any) -> str:
    text = "not set" if value is None else str(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"


def flat_items(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested sections with their full names, e.g. ``("model.layers", 4)``."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat_items(cast(Mapping[str, Any], value), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
