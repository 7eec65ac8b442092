"""`acwm doctor`: what this machine has, what really works, and what to install."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import click

from acwm_core.registry import Component

PACKAGES = ("torch", "lightning", "numpy", "gymnasium", "pydantic", "av", "pyarrow", "pluggy")
"""Packages whose versions explain most differences between two machines."""

SYSTEM_PACKAGES = {"libX11.so": "libx11-6", "libGL.so": "libgl1", "libEGL.so": "libegl1"}
"""Debian and Ubuntu packages of the shared libraries that simulators ask for."""

TRIAL_SECONDS = 120
"""Patience with one environment; compiling its kernels for the first time takes some."""

_MARKS = {True: "[green]ok[/green]", False: "[bold red]no[/bold red]", None: "[dim]--[/dim]"}

_TRIAL = """
import sys
from acwm_core.data.simulate import make_environment
environment = make_environment(sys.argv[1], {})
environment.reset(seed=0)
environment.step((environment.action_space.low + environment.action_space.high) / 2)
environment.close()
"""


class Finding(NamedTuple):
    """One line of the doctor's report; `works` is None for what is not installed."""

    what: str
    works: bool | None
    note: str


@click.command()
def doctor() -> None:
    """Say what works here and what to install.

    Starts every environment in a process of its own, which takes a minute. Exit code 1 if
    something that is installed does not work.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    failures = 0
    for finding in findings():
        failures += finding.works is False
        console.print(
            _MARKS[finding.works], Text(f"{finding.what:<28}"), Text(finding.note), soft_wrap=True
        )
    if failures:
        sys.exit(1)


def findings() -> Iterable[Finding]:
    """Everything the doctor looks at, as it is found."""
    from acwm_core.executors import available_cores

    yield _python()
    yield Finding("platform", True, f"{platform.platform()}, {available_cores()} cores")
    for package in PACKAGES:
        yield _package(package)
    yield _accelerator()
    yield from _plugins()
    yield from _executors()
    yield from _engines()


def _python() -> Finding:
    works = sys.version_info[:2] == (3, 11)
    advice = "" if works else "; the simulators ship wheels for Python 3.11 alone"
    return Finding("Python", works, f"{platform.python_version()}{advice}")


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, f"not installed: pip install {name}")


def _accelerator() -> Finding:
    import torch

    from acwm_core.training.trainer import cpu_has_fast_bfloat16

    if torch.cuda.is_available():
        names = {torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())}
        return Finding("accelerator", True, f"{torch.cuda.device_count()} × {', '.join(names)}")
    fast = cpu_has_fast_bfloat16()
    arithmetic = "bfloat16 in hardware: trains in it" if fast else "float32 only: trains in it"
    return Finding("accelerator", True, f"none; CPU with {arithmetic}")


def _plugins() -> Iterator[Finding]:
    from acwm_core.catalog import catalog

    for plugin in catalog().plugins:
        yield Finding(f"plugin {plugin}", True, "loaded")
    for problem in catalog().problems:
        yield Finding(f"plugin {problem.plugin}", False, problem.reason)


def _executors() -> Iterator[Finding]:
    """Whether what each needs is installed; the cluster may be elsewhere."""
    from acwm_core.catalog import catalog

    for component in catalog().registry("executor"):
        needs = _needs(component)
        note = ", ".join(f"{m} {_package(m).note}" for m in component.requires) or "installed"
        yield Finding(f"executor {component.name}", None if needs else True, needs or note)


def _engines() -> Iterator[Finding]:
    """One trial per module that defines environments; the names in it share an engine."""
    from acwm_core.catalog import catalog

    by_module: dict[str, Component] = {}
    for component in catalog().registry("environment"):
        by_module.setdefault(component.target.partition(":")[0], component)
    for component in by_module.values():
        yield trial(component)


def _needs(component: Component) -> str:
    """What is not installed that it needs, and how to install it; empty if all is."""
    missing = component.missing_modules()
    install = component.install_command(missing[0]) if missing else ""
    return f"needs {', '.join(missing)}: {install}" if missing else ""


def trial(component: Component) -> Finding:
    """Start an environment and take a step, in its own process: a bad library may crash it."""
    what = f"environment {component.name}"
    needs = _needs(component)
    if needs:
        return Finding(what, None, needs)
    engine = ", ".join(f"{m} {_package(m).note}" for m in component.requires)
    try:
        subprocess.run(
            [sys.executable, "-c", _TRIAL, component.name],
            check=True,
            capture_output=True,
            text=True,
            timeout=TRIAL_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return Finding(what, False, f"no frame after {TRIAL_SECONDS} s ({engine})")
    except subprocess.CalledProcessError as error:
        return Finding(what, False, _reason(error.stderr) or f"exit code {error.returncode}")
    return Finding(what, True, f"simulates and renders ({engine})" if engine else "simulates")


def _reason(stderr: str) -> str:
    """The last line of a traceback, with the package of a missing system library."""
    line = (stderr.strip().splitlines() or [""])[-1]
    library = re.search(r"(lib\w+\.so)\S*: cannot open shared object", line)
    if library and library[1] in SYSTEM_PACKAGES:
        line += f"; sudo apt-get install {SYSTEM_PACKAGES[library[1]]}"
    return line
