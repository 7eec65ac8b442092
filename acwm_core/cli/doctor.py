"""`acwm doctor`: report what this machine has, what works, and what to install."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import click

from acwm_core.plugins import Component

PACKAGES = ("torch", "lightning", "numpy", "gymnasium", "pydantic", "av", "pyarrow", "pluggy")
"""Packages whose versions explain most differences between two machines."""

SYSTEM_PACKAGES = {"libX11.so": "libx11-6", "libGL.so": "libgl1", "libEGL.so": "libegl1"}
"""Debian and Ubuntu packages of the shared libraries that simulators need."""

TRIAL_SECONDS = 120
"""Time limit in seconds for one environment; compiling its kernels takes a while at first."""

_MARKS = {True: "[green]ok[/green]", False: "[bold red]no[/bold red]", None: "[dim]--[/dim]"}

_TRIAL = """
import sys
from acwm_core.data.simulate import make_environment
from acwm_core.errors import sentence
try:
    environment = make_environment(sys.argv[1], {})
    environment.reset(seed=0)
    environment.step((environment.action_space.low + environment.action_space.high) / 2)
    environment.close()
except Exception as error:
    sys.exit(sentence(error))
"""


class Diagnosis(NamedTuple):
    """One line of the doctor's report; `works` is None if it is not installed."""

    what: str
    works: bool | None
    note: str


@click.command()
def doctor() -> int:
    """Test the installation and advise what to install.

    Starts an environment of every simulator in its own process. Exit code 1 if something that is
    installed does not work.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    failures = 0
    with console.status("checking; the simulators take some seconds"):
        for what, works, note in findings():
            failures += works is False
            console.print(_MARKS[works], Text(f"{what:<28}"), Text(note), soft_wrap=True)
    return int(failures > 0)


def findings() -> Iterator[Diagnosis]:
    """Yield all findings of the doctor, one by one."""
    from acwm_core.executors import available_cores
    from acwm_core.plugins import catalog

    works = (3, 11) <= sys.version_info < (3, 14)
    advice = "" if works else "; the simulators ship wheels only for Python 3.11, 3.12 and 3.13"
    yield Diagnosis("Python", works, f"{platform.python_version()}{advice}")
    yield Diagnosis("platform", True, f"{platform.platform()}, {available_cores()} cores")
    yield from map(_package, PACKAGES)
    yield Diagnosis("accelerator", True, _accelerator())
    for plugin in catalog().plugins:
        yield Diagnosis(f"plugin {plugin}", True, "loaded")
    for problem in catalog().problems:
        yield Diagnosis(f"plugin {problem.plugin}", False, problem.reason)
    for component in catalog().registry("executor"):  # the cluster may be elsewhere
        note = component.needs or _versions(component) or "installed"
        yield Diagnosis(f"executor {component.name}", None if component.needs else True, note)
    engines: dict[object, list[Component]] = {}  # by required packages or module
    for component in catalog().registry("environment"):
        engine = component.requires or component.target.partition(":")[0]
        engines.setdefault(engine, []).append(component)
    with ThreadPoolExecutor(available_cores()) as pool:
        yield from pool.map(trial_of_engine, engines.values())


def trial_of_engine(components: Sequence[Component]) -> Diagnosis:
    """Try the first of several environments that share a simulator, and name the others."""
    first, *others = components
    what, works, note = trial(first)
    names = ", ".join(other.name for other in others)
    return Diagnosis(what, works, f"{note}; same simulator as {names}" if names else note)


def trial(component: Component) -> Diagnosis:
    """Start an environment and take a step, in its own process as a bad library may crash it."""
    what = f"environment {component.name}"
    if component.needs:
        return Diagnosis(what, None, component.needs)
    engine = _versions(component)
    try:
        command = [sys.executable, "-P", "-c", _TRIAL, component.name]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=TRIAL_SECONDS)
    except subprocess.TimeoutExpired:
        return Diagnosis(what, False, f"no frame after {TRIAL_SECONDS} s ({engine})")
    except subprocess.CalledProcessError as error:
        return Diagnosis(what, False, _reason(error.stderr) or f"exit code {error.returncode}")
    return Diagnosis(what, True, f"simulates and renders ({engine})" if engine else "simulates")


def _package(name: str) -> Diagnosis:
    try:
        return Diagnosis(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Diagnosis(name, False, f"not installed: pip install {name}")


def _versions(component: Component) -> str:
    return ", ".join(f"{module} {_package(module).note}" for module in component.requires)


def _accelerator() -> str:
    import torch

    from acwm_core.training.precision import automatic_precision

    precision = f"training uses trainer.precision={automatic_precision('auto')}"
    if torch.cuda.is_available():
        names = {torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())}
        return f"{torch.cuda.device_count()} × {', '.join(names)}; {precision}"
    return f"none; {precision} on the CPU"


def _reason(stderr: str) -> str:
    line = (stderr.strip().splitlines() or [""])[-1]
    library = re.search(r"(lib\w+\.so)\S*: cannot open shared object", line)
    if library and library[1] in SYSTEM_PACKAGES:
        line += f"; sudo apt-get install {SYSTEM_PACKAGES[library[1]]}"
    return line
