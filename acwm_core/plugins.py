"""Plugins: the hooks that they implement, the components that they add, and finding them.

A plugin is any module or object named in the entry-point group ``acwm``::

    from acwm_core.plugins import hookimpl

    @hookimpl
    def register_environments(registry):
        registry.add("my_task", "my_package.my_task:MyTask", summary="…")

A registry maps a name to a target that is imported when the component is used. The catalog finds
the plugins; one that fails is left out and reported, and the others work.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, cast, get_args

import pluggy

from acwm_core.errors import MissingExtraError, PluginError, UnknownNameError, noting, sentence

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
    "check",
    "command",
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
            `acwm_core.env.physics.Physics`; the module imports no simulator.
        tasks: for an environment, ``"package.module:TASK"`` of its tasks by name, see
            `acwm_core.env.task.Task`; the modules import no simulator.
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
            PluginError: the module has no such attribute.
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
        return self._imported(self.tasks[name])

    def _imported(self, target: str) -> Any:
        module_name, _, attribute = target.partition(":")
        part = f"{self.part} of plugin {self.plugin!r}"
        try:
            with noting(f"in {part}", module_name):
                module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            missing = str(error.name).partition(".")[0]
            if missing == module_name.partition(".")[0]:
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
        """Import and construct the component; `params` override the preset `defaults`."""
        target = self.load()
        with noting(f"in {self.part} of plugin {self.plugin!r}", target):
            return target(**{**self.defaults, **params})

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


PROJECT = "acwm"
"""Name of the pluggy project and of the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec(historic=True)
def register_environments(registry: Registry) -> None:
    """Add environments; targets are subclasses of `acwm_core.env.environment.Environment`."""


@hookspec(historic=True)
def register_codecs(registry: Registry) -> None:
    """Add codecs; targets are subclasses of `acwm_core.model.codec.Codec`."""


@hookspec(historic=True)
def register_models(registry: Registry) -> None:
    """Add dynamics models; targets are subclasses of `acwm_core.model.dynamics.DynamicsModel`."""


@hookspec(historic=True)
def register_conditioners(registry: Registry) -> None:
    """Add conditioners; targets are subclasses of `acwm_core.model.conditioner.Conditioner`."""


@hookspec(historic=True)
def register_metrics(registry: Registry) -> None:
    """Add metrics; targets are subclasses of `acwm_core.evaluation.metric.Metric`."""


@hookspec(historic=True)
def register_estimators(registry: Registry) -> None:
    """Add estimators; targets are subclasses of `acwm_core.env.physics.StateEstimator`.

    An estimator has the name of its environment.
    """


@hookspec(historic=True)
def register_importers(registry: Registry) -> None:
    """Add importers; targets are subclasses of `CheckpointImporter`."""


@hookspec(historic=True)
def register_executors(registry: Registry) -> None:
    """Add executors; targets are subclasses of `acwm_core.executors.Executor`."""


@hookspec(historic=True)
def register_dataset_importers(registry: Registry) -> None:
    """Add formats to import; targets are subclasses of `acwm_core.data.formats.DatasetImporter`."""


@hookspec(historic=True)
def register_dataset_exporters(registry: Registry) -> None:
    """Add formats to export; targets are subclasses of `acwm_core.data.formats.DatasetExporter`."""


@hookspec(historic=True)
def register_protocols(registry: Registry) -> None:
    """Add protocols; targets are subclasses of `acwm_core.evaluation.protocol.Protocol`."""


@hookspec(historic=True)
def register_tables(registry: Registry) -> None:
    """Add published tables; targets return an `acwm_core.evaluation.benchmark.PublishedTable`."""


@hookspec(historic=True)
def register_trained_models(registry: Registry) -> None:
    """Add trained models, or sources of them; targets return the `Path` of a run folder.

    For a request ``NAME://ADDRESS``, the target gets the parameter ``address``.
    """


@hookspec(historic=True)
def register_gymnasium_environments(registry: Registry) -> None:
    """Add ``acwm/NAME-v0``; targets are `gymnasium.Env`s, whose `vector` serves `make_vec`."""


@hookspec(historic=True)
def register_tasks(registry: Registry) -> None:
    """Add tasks to environments of other plugins as ``ENVIRONMENT.TASK``; targets are `Task`s."""


@hookspec(historic=True)
def register_planners(registry: Registry) -> None:
    """Add planners; targets are subclasses of `Planner`."""


@hookspec(historic=True)
def register_costs(registry: Registry) -> None:
    """Add planning costs; targets are subclasses of `Cost`."""


@hookspec(historic=True)
def register_drivers(registry: Registry) -> None:
    """Add who can drive; targets are subclasses of `Driver`."""


@hookspec(historic=True)
def register_commands(registry: Registry) -> None:
    """Add commands of ``acwm``; targets are click commands, whose modules import nothing heavy.

    ``after="evaluate"`` lists a command after that one, and ``after="acwm"`` before all others.
    `acwm experiment` ends with the command named ``report``, as ``report FOLDER --out FILE``.
    """


@hookspec(historic=True)
def register_checks(registry: Registry) -> None:
    """Add conformance suites by the kind that they check; targets are called with a name."""


@dataclass(frozen=True)
class Problem:
    """A plugin that could not be loaded, and why; the others are unaffected."""

    plugin: str
    reason: str


class Catalog:
    """The registries of all kinds, and the plugins that fill them.

    Attributes:
        plugins: names of the loaded plugins, in order.
        problems: the plugins that could not be loaded, with the reason.
    """

    def __init__(self) -> None:
        self.plugins: list[str] = []
        self.problems: list[Problem] = []
        self._registries = {kind: Registry(kind) for kind in COMPONENT_KINDS}
        self._registries["executor"].registering("acwm_core", "acwm")
        self._registries["executor"].add(
            "processes",
            "acwm_core.executors:LocalExecutor",
            summary="processes of this machine; --workers 0 for none",
        )
        self._manager = pluggy.PluginManager(PROJECT)
        self._manager.add_hookspecs(sys.modules[__name__])
        for kind, registry in self._registries.items():
            # Historic: pluggy passes this registry to every plugin that is registered later.
            hook = getattr(self._manager.hook, f"register_{kind}s")
            hook.call_historic(kwargs={"registry": registry})

    def registry(self, kind: ComponentKind) -> Registry:
        """The registry of one kind."""
        return self._registries[kind]

    def component(self, kind: ComponentKind, name: str) -> Component:
        """Look up a component.

        Raises:
            UnknownNameError: there is none; suggests a similar name, and lists broken plugins.
        """
        registry = self._registries[kind]
        if name not in registry and self.problems:
            left = "; ".join(f"plugin {p.plugin!r} was left out: {p.reason}" for p in self.problems)
            known = registry.components()
            raise UnknownNameError(kind.replace("_", " "), name, known, f"({left})")
        return registry[name]

    def create(self, kind: ComponentKind, name: str, **params: Any) -> Any:
        """Construct a component by name, importing its target now."""
        return self.component(kind, name).create(**params)

    def add_plugin(self, plugin: object, name: str, distribution: str | None = None) -> None:
        """Register a plugin object, e.g. from a notebook, a test, or an entry point.

        Args:
            plugin: a module or object with hook implementations.
            name: a unique name for it.
            distribution: the package to pip install for its extras.

        Raises:
            PluginError: a plugin of that name is already loaded; or this one implements no hook or
                removes components of others.
            Exception: whatever the plugin raised, after everything it added was removed again.
        """
        if self._manager.has_plugin(name):
            raise PluginError(f"a plugin named {name!r} is already loaded")
        before = {kind: registry.components() for kind, registry in self._registries.items()}
        for registry in self._registries.values():
            registry.registering(name, distribution)
        try:
            self._manager.register(plugin, name)
            self._manager.check_pending()  # raises for a misspelt hook
            if not self._manager.get_hookcallers(plugin):
                raise PluginError("it implements no hook: mark its functions with @hookimpl")
            for kind, registry in self._registries.items():
                now = registry.components()
                for component in before[kind].values():
                    if now.get(component.name) is not component:
                        raise PluginError(f"it takes away {component.part} of another plugin")
        except BaseException:
            if self._manager.has_plugin(name):
                self._manager.unregister(name=name)
            for kind, registry in self._registries.items():
                registry.restore(before[kind])
            raise
        self.plugins.append(name)
        self._share_tasks()

    def _share_tasks(self) -> None:
        """Give environments the tasks that others registered for them, and register their own."""
        environments = self._registries["environment"].components()
        for task in self._registries["task"]:
            environment, _, name = task.name.partition(".")
            if environment in environments:
                cast(dict[str, str], environments[environment].tasks).setdefault(name, task.target)
        for owner in environments.values():
            for name, target in owner.tasks.items():
                task = Component(
                    "task", f"{owner.name}.{name}", target, owner.plugin, owner.distribution
                )
                self._registries["task"].include(task)

    def load_entry_points(self) -> None:
        """Load every plugin of the entry-point group, in order of name, each independently."""
        for entry_point in self._entry_points():
            try:
                distribution = entry_point.dist.name if entry_point.dist else None
                with noting(f"in {entry_point.value}", entry_point.value):
                    self.add_plugin(entry_point.load(), entry_point.name, distribution)
            except (Exception, SystemExit) as error:  # a module may even call sys.exit
                self.problems.append(Problem(entry_point.name, sentence(error)))

    def _entry_points(self) -> list[importlib.metadata.EntryPoint]:
        """The entry points of all distributions; those with a damaged file become problems."""
        found: dict[tuple[str, str], importlib.metadata.EntryPoint] = {}
        for distribution in importlib.metadata.distributions():
            try:
                for point in distribution.entry_points.select(group=PROJECT):
                    found.setdefault((point.name, point.value), point)
            except Exception as error:  # possibly of an unrelated package
                where = str(getattr(distribution, "_path", distribution))
                self.problems.append(Problem(where, sentence(error)))
        return [found[key] for key in sorted(found)]


@functools.cache
def catalog() -> Catalog:
    """The catalog of this process, filled from the installed entry points on first use."""
    found = Catalog()
    found.load_entry_points()
    return found
