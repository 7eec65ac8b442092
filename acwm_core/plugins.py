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

import contextlib
import functools
import importlib
import importlib.metadata
import importlib.util
import re
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import pluggy

from acwm_core.errors import (
    AcwmError,
    MissingExtraError,
    PluginError,
    noting,
    sentence,
    unknown_name,
)

Made = TypeVar("Made")

KINDS = {
    "environment": ("acwm_core.env.environment:Environment", "a world to act in"),
    "codec": ("acwm_core.model.codec:Codec", "video to latents and back"),
    "model": ("acwm_core.model.dynamics:DynamicsModel", "predicts latents"),
    "conditioner": ("acwm_core.model.conditioner:Conditioner", "brings actions into a model"),
    "objective": (
        "acwm_core.model.objectives.objective:Objective",
        "how a model learns, and how it predicts",
    ),
    "metric": ("acwm_core.evaluation.metric:Metric", "scores predicted video"),
    "estimator": (
        "acwm_core.env.physics:StateEstimator",
        "reads states from frames; has the name of its environment",
    ),
    "task": ("acwm_core.env.task:Task", "a goal; its name is ENVIRONMENT.TASK"),
    "executor": ("acwm_core.executors:Executor", "runs work elsewhere"),
    "protocol": (
        "acwm_core.evaluation.protocol:Protocol",
        "which clips an evaluation predicts, and published scores on them",
    ),
    "trained_model": ("pathlib:Path", "a run folder; of NAME://ADDRESS, made from an address"),
    "advisor": (
        "acwm_core.recipe.advice:Advisor",
        "chooses an overlay for data; recipes name it",
    ),
    "command": ("click:Command", "a command of acwm; its module imports nothing heavy"),
}
"""Core's kinds of component: what a target is, and in a phrase. Plugins add kinds of their own."""

UNCHECKED = ("executor", "protocol", "trained_model", "advisor", "command")
"""Those without a conformance suite; all others have one, ``acwm_core.checks.check_KIND``."""

OWN = {
    "objective": {
        "full_sequence": (
            "model.objectives.full_sequence:FullSequence",
            "flow matching with one noise level per clip, as in the paper; no streams",
        ),
        "diffusion_forcing": (
            "model.objectives.diffusion_forcing:DiffusionForcing",
            "flow matching with one noise level per latent frame; for causal models",
        ),
        "next_frame": (
            "model.objectives.next_frame:NextFrame",
            "flow matching of each latent frame after a clean past; for causal models",
        ),
        "regression": (
            "model.objectives.regression:Regression",
            "squared error of a prediction at once; for models that do not denoise",
            {"state_weight": ..., "motion_steps": ...},
        ),
    },
    "executor": {
        "processes": (
            "executors:LocalExecutor",
            "processes of this machine; --workers 0 for none",
        ),
    },
}
"""Core's own components by kind and name: target and summary."""


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
        install: what to do instead if the extra cannot install them, e.g. on this Python.
        defaults: parameters preset by this name, e.g. a model size; recipes may override them.
        physics: for an environment, ``"package.module:function"`` of its physics, see
            `acwm_core.env.physics.Physics`; the module imports no simulator.
        tasks: for an environment, ``"package.module:TASK"`` of its tasks by name, see
            `acwm_core.env.task.Task`; the modules import no simulator.
        objective: for a model, the objective that it learns by if none was chosen along with it.
        retired: parameters that earlier versions had, and recipes of old runs name, with the value
            at which they did what is done today; `...` if it does not matter.
    """

    kind: str
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
    objective: str | None = None
    install: str = ""
    retired: Mapping[str, Any] = field(default_factory=dict[str, Any])

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
            RecipeError: it has no task of that name.
            PluginError: as for `load`.
        """
        if name not in self.tasks:
            raise unknown_name(f"{self.name} task", name, self.tasks)
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
        where = f"in {self.part} of plugin {self.plugin!r}"
        with noting(where, target, unless=AcwmError):  # those of wrong parameters say all
            return target(**{**self.defaults, **params})

    def create_as(self, base: type[Made], **params: Any) -> Made:
        """Construct the component; `PluginError` if the result is not a `base`."""
        instance = self.create(**params)
        if not isinstance(instance, base):
            raise PluginError(
                f"{self.part} returns a {type(instance).__name__}, not a {base.__name__}"
            )
        return instance

    def install_command(self, module: str) -> str:
        """The command that installs `module`, by the plugin's extra if it names one."""
        if self.install:
            return self.install
        if self.extra and self.distribution:
            module = f"{self.distribution}[{self.extra}]"
        return f"pip install '{module}'"

    @property
    def needs(self) -> str:
        """Which required modules are not installed, and how to install them; empty if none."""
        missing = self.missing_modules()
        how = self.install_command(missing[0]) if missing else ""
        return f"needs {', '.join(missing)}: {how}" if missing else ""

    def missing_modules(self) -> list[str]:
        """Modules in `requires` whose top-level package is not installed; imports nothing."""
        return [m for m in self.requires if importlib.util.find_spec(m.partition(".")[0]) is None]


class Registry:
    """The components of one kind. Each hook of a plugin gets a registry and calls its `add`."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
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
        objective: str | None = None,
        install: str = "",
        retired: Mapping[str, Any] | None = None,
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
            objective: for a model, the objective that it learns by, if it has one of its own.
            install: what to do if the extra cannot install these modules, e.g. on this Python.
            retired: parameters of earlier versions, see `Component.retired`.
            **defaults: parameters that this name presets.

        Raises:
            PluginError: the name is taken or malformed, or the target is not ``"module:Name"``.
        """
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise PluginError(f"{self.kind} {name!r} must consist of letters, digits, _, - and .")
        if not re.fullmatch(r"\w+(\.\w+)*:\w+", target):
            raise PluginError(f"target {target!r} of {self.kind} {name!r} is not 'module:Name'")
        if isinstance(requires, str):
            raise PluginError(f"requires={requires!r} of {self.kind} {name!r} must be a tuple")
        if name in self._components:
            owner = self._components[name].plugin
            raise PluginError(f"{self.kind} {name!r} is already registered by plugin {owner!r}")
        self._components[name] = Component(
            *(self.kind, name, target, self._plugin, self._distribution, summary, extra, requires),
            *(defaults, physics, dict(tasks or {}), objective, install, dict(retired or {})),
        )

    def include(self, component: Component) -> None:
        """Add a component that is known from elsewhere, unless its name is taken."""
        self._components.setdefault(component.name, component)

    def __getitem__(self, name: str) -> Component:
        """Look up a component; `RecipeError` suggests a similar name."""
        try:
            return self._components[name]
        except KeyError:
            raise unknown_name(self.kind.replace("_", " "), name, self._components) from None

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
        """Restore earlier `components`, to undo the changes of a broken plugin."""
        self._components = dict(components)


PROJECT = "acwm"
"""Name of the pluggy project and of the entry-point group."""

hookimpl = pluggy.HookimplMarker(PROJECT)


def _hook_of(kind: str) -> tuple[str, type]:
    """The name of the hook of a kind, and a namespace with its specification for pluggy."""

    def register(registry: Registry) -> None: ...

    name = f"register_{kind}s"
    specification = pluggy.HookspecMarker(PROJECT)(register, historic=True)
    return name, type("Hooks", (), {name: specification})


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
        self._registries: dict[str, Registry] = {}
        self._manager = pluggy.PluginManager(PROJECT)
        self._open("kind")
        for kind, (target, summary) in KINDS.items():
            check = "" if kind in UNCHECKED else f"acwm_core.checks:check_{kind}"
            self.registry("kind").add(kind, target, summary=summary, check=check)
            self._open(kind)
        for kind, components in OWN.items():
            for name, (target, summary, *retired) in components.items():
                self.registry(kind).add(
                    name, f"acwm_core.{target}", summary=summary, retired=dict(*retired)
                )

    def _open(
        self, kind: str, plugin: str = "acwm_core", distribution: str | None = "acwm"
    ) -> None:
        """Create the registry of a kind, and the hook by which plugins fill it."""
        name, specification = _hook_of(kind)
        self._manager.add_hookspecs(specification)
        self._registries[kind] = registry = Registry(kind)
        registry.registering(plugin, distribution)
        # Historic: pluggy passes this registry to every plugin, also to those registered later.
        getattr(self._manager.hook, name).call_historic(kwargs={"registry": registry})

    @property
    def kinds(self) -> list[str]:
        """The kinds of components, those of core first."""
        return [kind for kind in self._registries if kind != "kind"]

    def registry(self, kind: str) -> Registry:
        """The registry of one kind; `RecipeError` suggests a similar kind."""
        if kind not in self._registries:
            raise unknown_name("kind", kind, self._registries)
        return self._registries[kind]

    def component(self, kind: str, name: str) -> Component:
        """Look up a component.

        Raises:
            RecipeError: there is none; suggests a similar name, and lists broken plugins.
        """
        registry = self.registry(kind)
        if name not in registry and self.problems:
            left = "; ".join(f"plugin {p.plugin!r} was left out: {p.reason}" for p in self.problems)
            known = registry.components()
            raise unknown_name(kind.replace("_", " "), name, known, f"({left})")
        return registry[name]

    def create(self, kind: str, name: str, **params: Any) -> Any:
        """Construct a component by name, importing its target now."""
        return self.component(kind, name).create(**params)

    def add_plugin(self, plugin: object, name: str, distribution: str | None = None) -> None:
        """Register a plugin object, e.g. from a notebook, a test, or an entry point.

        Args:
            plugin: a module or object with hook implementations.
            name: a unique name for it.
            distribution: the package to pip install for its extras.

        Raises:
            PluginError: a plugin of that name is already loaded; or this one implements no hook.
            Exception: whatever the plugin raised, after everything it added was removed again.
        """
        if self._manager.has_plugin(name):
            raise PluginError(f"a plugin named {name!r} is already loaded")
        before = {kind: registry.components() for kind, registry in self._registries.items()}
        for registry in self._registries.values():
            registry.registering(name, distribution)
        try:
            self._register(plugin, name, distribution)
        except BaseException:
            if self._manager.has_plugin(name):
                self._manager.unregister(name=name)
            for kind, registry in self._registries.items():
                registry.restore(before.get(kind, {}))
            raise
        self.plugins.append(name)
        self._share_tasks()

    def _register(self, plugin: object, name: str, distribution: str | None) -> None:
        """Let the hooks of a plugin add its components, also those of kinds that it adds itself."""
        self._manager.register(plugin, name)
        for kind in self._registries["kind"].components():
            if kind not in self._registries:
                self._open(kind, name, distribution)
        self._manager.check_pending()  # raises for a misspelt hook
        if not self._manager.get_hookcallers(plugin):
            raise PluginError("it implements no hook: mark its functions with @hookimpl")

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
        """Load every plugin of the entry-point group, each independently.

        They are registered in order of name, but those that add kinds come before all others.
        """
        loaded: list[tuple[importlib.metadata.EntryPoint, object]] = []
        for point in self._entry_points():
            with self._reporting(point):
                loaded.append((point, point.load()))

        @functools.cache  # a distribution reads its file again for each answer
        def name_of(distribution: importlib.metadata.Distribution | None) -> str | None:
            return distribution.name if distribution else None

        for point, plugin in sorted(
            loaded, key=lambda entry: not hasattr(entry[1], "register_kinds")
        ):
            with self._reporting(point):
                self.add_plugin(plugin, point.name, name_of(point.dist))

    @contextlib.contextmanager
    def _reporting(self, point: importlib.metadata.EntryPoint) -> Generator[None]:
        """Turn an error of the plugin in the block into a problem."""
        try:
            with noting(f"in {point.value}", point.value):
                yield
        except (Exception, SystemExit) as error:  # a module may even call sys.exit
            self.problems.append(Problem(point.name, sentence(error)))

    def _entry_points(self) -> list[importlib.metadata.EntryPoint]:
        """The entry points of all distributions; those with a damaged file become problems."""
        points: dict[tuple[str, str], importlib.metadata.EntryPoint] = {}
        for distribution in importlib.metadata.distributions():
            try:
                for point in distribution.entry_points.select(group=PROJECT):
                    points.setdefault((point.name, point.value), point)
            except Exception as error:  # possibly of an unrelated package
                where = str(getattr(distribution, "_path", distribution))
                self.problems.append(Problem(where, sentence(error)))
        return [points[key] for key in sorted(points)]


@functools.cache
def catalog() -> Catalog:
    """The catalog of this process, filled from the installed entry points on first use."""
    filled = Catalog()
    filled.load_entry_points()
    return filled
