"""The catalog of installed components: finds plugins, and records why broken ones are left out."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import signal
import threading
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, cast

import pluggy

from acwm_core import hooks
from acwm_core.errors import PluginError, UnknownNameError
from acwm_core.errors.plugin_code import explained, importing, is_by_an_author
from acwm_core.registry import COMPONENT_KINDS, Component, ComponentKind, Registry


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
        self._manager = pluggy.PluginManager(hooks.PROJECT)
        self._manager.add_hookspecs(hooks)
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
        with _noting_ctrl_c() as pressed:
            for entry_point in self._entry_points():
                is_by_an_author(entry_point.value)
                try:
                    distribution = entry_point.dist.name if entry_point.dist else None
                    with importing(f"plugin {entry_point.name!r} ({entry_point.value})"):
                        plugin = entry_point.load()
                        self.add_plugin(plugin, entry_point.name, distribution)
                except BaseException as error:  # a module may even call sys.exit
                    if pressed:
                        raise
                    reason = " ".join(explained(error).split())
                    self.problems.append(Problem(entry_point.name, reason))

    def _entry_points(self) -> list[importlib.metadata.EntryPoint]:
        """The entry points of all distributions; those with a damaged file become problems."""
        found: dict[tuple[str, str], importlib.metadata.EntryPoint] = {}
        for distribution in importlib.metadata.distributions():
            try:
                for point in distribution.entry_points.select(group=hooks.PROJECT):
                    found.setdefault((point.name, point.value), point)
            except Exception as error:  # possibly of an unrelated package
                where = str(getattr(distribution, "_path", distribution))
                self.problems.append(Problem(where, explained(error)))
        return [found[key] for key in sorted(found)]


@contextlib.contextmanager
def _noting_ctrl_c() -> Generator[list[int]]:
    """Yield a list that gets an entry on Ctrl-C. A plugin may also raise `KeyboardInterrupt`."""
    pressed: list[int] = []
    usual: Any = signal.getsignal(signal.SIGINT)
    heeded = callable(usual) and threading.current_thread() is threading.main_thread()
    if heeded:
        signal.signal(signal.SIGINT, lambda n, frame: (pressed.append(n), usual(n, frame)))
    try:
        yield pressed
    finally:
        if heeded:
            signal.signal(signal.SIGINT, usual)


@functools.cache
def catalog() -> Catalog:
    """The catalog of this process, filled from the installed entry points on first use."""
    found = Catalog()
    found.load_entry_points()
    return found
