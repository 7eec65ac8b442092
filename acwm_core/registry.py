"""Registries map names to lazily imported targets: plugins add components, users look them up."""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_args

from acwm_core.errors import MissingExtraError, PluginError, UnknownNameError
from acwm_core.errors.plugin_code import blaming, importing, is_by_an_author, mark, package_of

Made = TypeVar("Made")

ComponentKind = Literal[
    "environment",
    "codec",
    "model",
    "conditioner",
    "metric",
    "estimator",
    "importer",
    "dataset_importer",
    "dataset_exporter",
    "executor",
    "protocol",
    "table",
    "trained_model",
    "gymnasium_environment",
    "task",
    "planner",
    "cost",
    "driver",
    "command",
    "completion",
]
"""The kinds of component that a plugin can provide."""

COMPONENT_KINDS: tuple[ComponentKind, ...] = get_args(ComponentKind)


@dataclass(frozen=True)
class Component:
    """A registered component.

    Attributes:
        kind: its kind.
        name: its name in recipes and on the command line.
        target: ``"package.module:Attribute"``, imported only when the component is used.
        plugin: the entry point that registered it.
        distribution: package to pip install for that plugin; None if it came from a notebook.
        summary: one phrase for `acwm list`.
        extra: the extra of the plugin's distribution that installs its dependencies, if any.
        requires: modules that the extra installs, to check without importing if they are there.
        defaults: parameters preset by this name, e.g. a model size; recipes may override them.
        physics: for an environment, ``"package.module:function"`` of its physics, see
            `acwm_core.estimator.Physics`; the module imports no simulator.
        tasks: for an environment, ``"package.module:TASK"`` of its tasks by name, see
            `acwm_core.planning.task.Task`; the modules import no simulator.
    """

    kind: ComponentKind
    name: str
    target: str
    plugin: str
    distribution: str | None = None
    summary: str = ""
    extra: str | None = None
    requires: tuple[str, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict[str, Any])
    physics: str | None = None
    tasks: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def part(self) -> str:
        """Its name in messages, e.g. ``"environment 'push_cube'"``."""
        return f"{self.kind.replace('_', ' ')} {self.name!r}"

    def load(self) -> Any:
        """Import the target.

        Raises:
            MissingExtraError: a module outside the plugin's own package is not installed.
            PluginError: there is no such module or attribute, or the module raises.
        """
        return self._imported(self.target)

    def load_physics(self) -> Any:
        """Import the physics of an environment, for estimators; works without its simulator.

        Raises:
            PluginError: the environment has no physics, or as for `load`.
        """
        if self.physics is None:
            raise PluginError(f"{self.part} is registered without its physics")
        return self._imported(self.physics)

    def load_task(self, name: str) -> Any:
        """Import a task of an environment; works without its simulator.

        Raises:
            UnknownNameError: it has no task of that name.
            PluginError: as for `load`.
        """
        if name not in self.tasks:
            raise UnknownNameError(f"{self.name} task", name, self.tasks)
        found = self._imported(self.tasks[name])
        mark(found, f"task {name!r} of {self.part}")
        return found

    def _imported(self, target: str) -> Any:
        module_name, _, attribute = target.partition(":")
        part = f"{self.part} of plugin {self.plugin!r}"
        is_by_an_author(module_name)
        with (
            importing(f"{self.part} ({module_name})"),
            blaming("", part, doing="cannot be imported"),
        ):
            try:
                module = importlib.import_module(module_name)
            except ModuleNotFoundError as error:
                missing = package_of(error.name)
                if missing == package_of(module_name):
                    raise  # a module of the plugin itself: no extra has it
                needs = f"{self.part} needs {missing!r}"
                raise MissingExtraError(f"{needs}: {self.install_command(missing)}") from error
        try:
            return getattr(module, attribute)
        except AttributeError as error:
            raise PluginError(
                f"{part} points to {target}, but {module_name} has no {attribute!r}"
            ) from error

    def create(self, **params: Any) -> Any:
        """Import and construct the component; `params` override the preset `defaults`.

        Raises:
            PluginError: it cannot be constructed, e.g. because an abstract method is missing.
        """
        target = self.load()
        with blaming(part=self.part, of=target, doing="cannot be made"):
            made = target(**{**self.defaults, **params})
        if self.kind != "executor":  # it runs others' code
            mark(made, self.part)
        return made

    def create_as(self, base: type[Made], **params: Any) -> Made:
        """Construct the component; `PluginError` if the result is not a `base`."""
        made = self.create(**params)
        if not isinstance(made, base):
            raise PluginError(f"{self.part} returns a {type(made).__name__}, not a {base.__name__}")
        return made

    def install_command(self, module: str) -> str:
        """The command that installs `module`, by the plugin's extra if it names one."""
        if self.extra and self.distribution:
            module = f"{self.distribution}[{self.extra}]"
        return f"pip install '{module}'"

    def missing_modules(self) -> list[str]:
        """Modules in `requires` whose top-level package is not installed; imports nothing."""
        return [m for m in self.requires if importlib.util.find_spec(m.partition(".")[0]) is None]


class Registry:
    """The components of one kind. Each hook of a plugin gets a registry and calls its `add`."""

    def __init__(self, kind: ComponentKind) -> None:
        self.kind: ComponentKind = kind
        self._components: dict[str, Component] = {}
        self._plugin = ""
        self._distribution: str | None = None

    def add(
        self,
        name: str,
        target: str,
        *,
        summary: str = "",
        extra: str | None = None,
        requires: tuple[str, ...] = (),
        physics: str | None = None,
        tasks: Mapping[str, str] | None = None,
        **defaults: Any,
    ) -> None:
        """Register `name` for the lazy `target` ``"package.module:Attribute"``.

        Args:
            name: the name in recipes; unique within the kind.
            target: the class or factory; it is not imported now.
            summary: one phrase for `acwm list`.
            extra: the extra that installs what the target imports.
            requires: the modules that this extra installs, e.g. ``("mujoco",)``.
            physics: for an environment, the target of its physics, for estimators.
            tasks: for an environment, the targets of its tasks, by name.
            **defaults: parameters that this name presets.

        Raises:
            PluginError: the name is taken or malformed, the target is not ``"module:attribute"``,
                or an argument has the wrong type.
        """
        given: dict[str, tuple[object, Any]] = {
            **{"name": (name, str), "target": (target, str), "summary": (summary, str)},
            **{"extra": (extra, str | None), "physics": (physics, str | None)},
            **{"requires": (requires, tuple), "tasks": (tasks or {}, Mapping)},  # no strings
            **{f"requires[{place}]": (each, str) for place, each in enumerate(requires)},
        }
        if isinstance(tasks, Mapping):
            given |= {f"tasks[{each!r}]": (where, str) for each, where in tasks.items()}
        for what, (value, wanted) in given.items():
            if not isinstance(value, wanted):
                raise PluginError(
                    f"{what} of {self.kind} {name!r:.60} is of the wrong type: {value!r:.60}"
                )
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise PluginError(f"{self.kind} {name!r} must consist of letters, digits, _, - and .")
        if not re.fullmatch(r"\w+(\.\w+)*:\w+", target):
            raise PluginError(f"target {target!r} of {self.kind} {name!r} is not 'module:Name'")
        if name in self._components:
            owner = self._components[name].plugin
            raise PluginError(f"{self.kind} {name!r} is already registered by plugin {owner!r}")
        about = self._plugin, self._distribution, summary, extra, requires, defaults, physics
        self._components[name] = Component(self.kind, name, target, *about, dict(tasks or {}))

    def include(self, component: Component) -> None:
        """Add a component that is known from elsewhere, unless its name is taken."""
        self._components.setdefault(component.name, component)

    def __getitem__(self, name: str) -> Component:
        """Look up a component.

        Raises:
            UnknownNameError: nothing of this kind has that name; suggests a similar one.
        """
        try:
            return self._components[name]
        except KeyError:
            raise UnknownNameError(self.kind.replace("_", " "), name, self._components) from None

    def __contains__(self, name: object) -> bool:
        return name in self._components

    def __iter__(self) -> Iterator[Component]:
        return iter(sorted(self._components.values(), key=lambda component: component.name))

    def __len__(self) -> int:
        return len(self._components)

    def registering(self, plugin: str, distribution: str | None) -> None:
        """Attribute all components added from now on to `plugin` of that distribution."""
        self._plugin, self._distribution = plugin, distribution

    def components(self) -> dict[str, Component]:
        """A copy of the current components, by name."""
        return dict(self._components)

    def restore(self, components: Mapping[str, Component]) -> None:
        """Restore earlier `components`, e.g. to undo the changes of a broken plugin."""
        self._components = dict(components)
