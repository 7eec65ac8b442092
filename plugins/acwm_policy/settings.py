"""Settings of learning a policy, from overrides; a learner's parameters are those of its class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from acwm_core.errors import PluginError, RecipeError, suggest
from acwm_core.plugins import Component, catalog
from acwm_core.recipe.compose import parse_override
from acwm_core.recipe.types import checked
from acwm_policy.learner import Learner


@dataclass(frozen=True)
class PolicySettings:
    """How a policy learns.

    Attributes:
        algorithm: name of the learner.
        observe: names of the fields of the state to observe; by default those that are predicted
            and that an estimator reads. Of recordings, ``["pictures"]`` observes their frames.
        bonus: reward for success; the way from a usual start to the goal is worth 1.
        parameters: of the learner, those that were set.
    """

    algorithm: str = "sac"
    observe: list[str] | None = None
    bonus: float = 1.0
    parameters: dict[str, Any] = field(default_factory=dict[str, Any])

    def learner(self) -> Learner:
        """Make the learner."""
        return learner_component(self.algorithm).create_as(Learner, **self.parameters)


def learner_component(name: str) -> Component:
    """The component of a learner.

    Raises:
        RecipeError: there is no such learner.
    """
    known = catalog().registry("learner")
    if name not in known:
        names = [component.name for component in known]
        raise RecipeError(
            f"there is no algorithm {name!r}{suggest(name, names)}; give {', '.join(names)}"
        )
    return known[name]


def learner_class(name: str) -> type[Learner]:
    """The class of a learner.

    Raises:
        RecipeError: there is no such learner.
        MissingExtraError: what it needs is not installed.
        PluginError: it is not a `Learner`.
    """
    component = learner_component(name)
    learner = component.load()
    if not (isinstance(learner, type) and issubclass(learner, Learner)):
        raise PluginError(f"{component.part} is {learner!r:.60}, which is not a Learner")
    return cast("type[Learner]", learner)


def settings_of(overrides: Sequence[str]) -> PolicySettings:
    """Build the settings from overrides such as ``algorithm=ppo`` and ``learning_rate=1e-3``.

    Raises:
        RecipeError: a setting, or a parameter of the learner, does not exist or has a wrong value.
        MissingExtraError: what the learner needs is not installed.
    """
    given: dict[str, Any] = {}
    for override in overrides:
        for name, value in parse_override(override).items():
            given[name] = {**given.get(name, {}), **value} if isinstance(value, dict) else value
    own: dict[str, Any] = {
        "algorithm": checked("algorithm", given.pop("algorithm", "sac"), str),
        "observe": checked("observe", _listed(given.pop("observe", None)), list[str] | None),
        "bonus": checked("bonus", given.pop("bonus", 1.0), float),
    }
    known = learner_class(own["algorithm"]).parameters()
    for name in given:
        if name not in known:
            raise _unknown(name, own, known)
    parameters = {name: checked(name, value, known[name].type) for name, value in given.items()}
    settings = PolicySettings(**own, parameters=parameters)
    settings.learner()  # checks what types cannot express
    return settings


def _listed(value: Any) -> Any:
    """A name as the list of it."""
    return [value] if isinstance(value, str) else value


def _unknown(name: str, own: Mapping[str, Any], known: Mapping[str, Any]) -> RecipeError:
    near = suggest(name, [*own, *known])
    return RecipeError(
        f"{own['algorithm']} has no parameter {name!r}{near}; it has {', '.join(known)}, and "
        "beside these you can set algorithm, observe and bonus"
    )
