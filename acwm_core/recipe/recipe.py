"""The `Recipe`: everything that makes an experiment, checked and with every default written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

from acwm_core.recipe.compose import COMPONENTS, read_recipe
from acwm_core.recipe.text import dump
from acwm_core.recipe.validate import validate


@dataclass(frozen=True)
class ComponentConfig:
    """A component that a recipe chose: a registered name and all its parameters."""

    name: str
    params: dict[str, Any]


@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Attributes:
        env: the environment that the data came from; None for whatever ``data.path`` holds.
        codec: the video autoencoder.
        model: the dynamics model.
        conditioner: how actions enter it.
        flow: keyword arguments of `acwm_core.flow.Flow`.
        training: keyword arguments of `acwm_core.training.config.TrainingConfig`.
        data: keyword arguments of `acwm_core.data.clips.DataConfig`.
        evaluation: keyword arguments of `acwm_core.evaluation.config.EvaluationConfig`.
        trainer: keyword arguments of Lightning's `Trainer`, those that were set.
    """

    env: ComponentConfig | None
    codec: ComponentConfig
    model: ComponentConfig
    conditioner: ComponentConfig
    flow: dict[str, Any]
    training: dict[str, Any]
    data: dict[str, Any]
    evaluation: dict[str, Any]
    trainer: dict[str, Any]

    @classmethod
    def from_dict(cls, sections: Mapping[str, Any]) -> Recipe:
        """Check sections as a recipe file holds them.

        Raises:
            RecipeError: a name, parameter or type is wrong.
        """
        checked = validate(sections)
        components = {
            section: ComponentConfig(
                values["name"], {k: v for k, v in values.items() if k != "name"}
            )
            if (values := checked.get(section))
            else None
            for section in COMPONENTS
        }
        return cls(**{**checked, **components})  # pyright: ignore[reportArgumentType]

    @classmethod
    def from_yaml(cls, path: str | Path) -> Recipe:
        """Read a recipe file, e.g. the one saved in a run."""
        return compose(path)

    def to_dict(self) -> dict[str, Any]:
        """Sections as a recipe file holds them, of plain JSON types."""
        sections: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, ComponentConfig):
                value = {"name": value.name, **value.params}
            if value is not None:
                sections[field.name] = _plain(value)
        return sections

    def to_yaml(self) -> str:
        """The recipe as a file that stands on its own; `from_yaml` reads it back."""
        return dump(self.to_dict())


def compose(recipe: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Read a recipe, apply overrides to it and check everything, without importing torch.

    Args:
        recipe: a path, or the name of a packaged recipe such as ``push_cube_small``.
        overrides: ``conditioner=cross_attention``, ``model.layers=4``, ``trainer.devices=2`` …

    Raises:
        RecipeError: a file, name, parameter or type is wrong; suggests the nearest right one.
    """
    return Recipe.from_dict(read_recipe(recipe, overrides))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in cast(Mapping[str, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast(Sequence[Any], value)]
    return str(value) if isinstance(value, Path) else value
