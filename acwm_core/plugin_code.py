"""Run plugin code: report its errors in one sentence, and name imports that hang."""

from __future__ import annotations

import contextlib
import dis
import importlib
import inspect
import sys
import threading
import traceback
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acwm_core.errors import AcwmError, PluginError, RecipeError

if TYPE_CHECKING:
    from numpy.typing import NDArray

PATIENCE = 10.0
"""Seconds after which an unfinished import is named on stderr."""

AUTHORS: set[str] = set()
"""Top-level packages of plugins and components. In a traceback, they are the authors' code."""

CORE = __name__.partition(".")[0]

_PART = "_acwm_part"


def package_of(module: object) -> str:
    """The top-level package in the name of a module or target (``module:name``)."""
    return str(module).partition(":")[0].partition(".")[0]


def is_by_an_author(module: object) -> None:
    """Register the top-level package of a module as an author's code."""
    AUTHORS.update({package_of(module)} - {CORE})


def mark(made: object, part: str) -> None:
    """Report errors in the methods of `made` as those of `part`, e.g. ``"codec 'wan'"``."""
    with contextlib.suppress(AttributeError, TypeError):  # it may not take attributes
        object.__setattr__(made, _PART, part)


def explained(error: BaseException, of: object = None) -> str:
    """``"ValueError: message (file:line)"``, where the line is the last one in an author's code.

    If the traceback has no such line, it is the first line of the class of `of`, if there is one.
    """
    where, found = "", [*traceback.walk_tb(error.__traceback__)]
    if isinstance(error, WrongResultError):
        found = []  # it was raised elsewhere, by a check of acwm
    lines = [(frame.f_code.co_filename, n) for frame, n in found if _is_authors(frame.f_globals)]
    target = of if isinstance(of, type) else type(of)
    with contextlib.suppress(OSError, TypeError):  # no file: a notebook or a builtin
        if not lines and package_of(target.__module__) in AUTHORS:
            lines = [(inspect.getfile(target), inspect.getsourcelines(target)[1])]
    if lines:
        path = Path(lines[-1][0])
        here = path.is_relative_to(Path.cwd())
        where = f" ({path.relative_to(Path.cwd()) if here else path}:{lines[-1][1]})"
    try:
        message = " ".join(str(error).split())
    except Exception:  # an author's exception class may fail in __str__
        message = ""
    return f"{type(error).__name__}: {message}".removesuffix(": ") + where


@contextlib.contextmanager
def blaming(
    where: str = "",
    part: object = None,
    *,
    of: object = None,
    doing: str = "failed",
    leaving: Callable[[BaseException], object] = lambda error: False,
) -> Generator[None]:
    """Turn errors of plugin code in the block into a `PluginError` that names the plugin and line.

    This includes `SystemExit` and a raised `KeyboardInterrupt`: a plugin cannot end the program or
    fake a Ctrl-C. An `AcwmError` and a real Ctrl-C pass unchanged.

    Args:
        where: e.g. ``"in episode 3 of train"``.
        part: what runs, as a name or a component. Without it, errors that neither pass through a
            method of a component nor arise in an author's code pass unchanged.
        of: the class, if `part` is a name.
        doing: what the part did wrong, for the message.
        leaving: whether an error passes unchanged if no component raised it.

    Raises:
        PluginError: replaces the plugin's error, which is its cause.
    """
    try:
        yield
    except AcwmError:
        raise
    except BaseException as error:
        if is_true_stop(error) or type(error).__module__.startswith("click."):
            raise  # Ctrl-C, or click's way to end a command
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)][::-1]
        owners = [getattr(error, "component", None), *(f.f_locals.get("self") for f in frames)]
        marked = (each for each in owners if _PART in getattr(each, "__dict__", {}))
        owner = next(marked, owners[0] or part)
        known = [frame.f_globals for frame in frames]
        last = next((each for each in known if _is_authors(each) or _is_core(each)), known[-1])
        if owner is None and (not _is_authors(last) or leaving(error)):
            raise
        if isinstance(error, SystemExit) and _is_core(last):
            raise  # from our handler of a signal
        name = owner if isinstance(owner, str) else getattr(owner, _PART, type(owner).__name__)
        name = "code of a plugin" if owner is None else name
        what = " ".join(word for word in (str(name), doing, where) if word)
        raise PluginError(f"{what}: {explained(error, of or owner)}") from error


def is_true_stop(error: BaseException) -> bool:
    """Whether it is a real Ctrl-C or the end of a generator, not raised by an author's code.

    Python raises these between two instructions, or in acwm_core's signal handler.
    """
    if not isinstance(error, KeyboardInterrupt | GeneratorExit):
        return False
    last = error.__traceback__
    while last and last.tb_next:
        last = last.tb_next
    if last is None or not _is_authors(last.tb_frame.f_globals) or error.__context__:
        return True
    return last.tb_frame.f_code.co_code[last.tb_lasti] != dis.opmap["RAISE_VARARGS"]


class WrongResultError(ValueError):
    """A component's method returned what its interface forbids; `blaming` names the component."""

    def __init__(self, component: object, method: str, made: Any, wanted: object) -> None:
        gave = f"{made!r:.40}"
        if hasattr(made, "dtype"):
            gave = f"{type(made).__name__} {[*made.shape]} {made.dtype}"
        super().__init__(f"{method} gives {gave}, not {wanted}")
        self.component = component


def shaped(component: object, method: str, made: Any, *shape: int) -> Any:
    """Return `made`, the array or tensor that a method returned, if it has this shape.

    In `shape`, -1 stands for any length; without a shape, a single number is expected.

    Raises:
        WrongResultError: it has another shape.
    """
    found: Any = getattr(made, "shape", [None] * 9)
    if len(found) != len(shape) or any(b not in (-1, a) for a, b in zip(found, shape, strict=True)):
        raise WrongResultError(component, method, made, f"the shape {[*shape]}".replace("-1", "n"))
    return made


def numbers(
    component: object, method: str, made: object, *shape: int, dtype: Any = None
) -> NDArray[Any]:
    """As `shaped`, for any array-like of real numbers, or only of type `dtype` if it is given."""
    import numpy as np  # not needed to list the installed components

    found = np.asarray(made)
    if found.dtype.kind not in "fiub" or dtype not in (None, found.dtype):
        wanted = "numbers" if dtype is None else f"of type {np.dtype(dtype)}"
        raise WrongResultError(component, method, made, wanted)
    return shaped(component, method, found, *shape)


@contextlib.contextmanager
def importing(what: str) -> Generator[None]:
    """Say on stderr what is being imported if it takes more than `PATIENCE` seconds."""
    told = f"acwm: {what} has been importing for {PATIENCE:g} s; Ctrl-C stops it"
    timer = threading.Timer(PATIENCE, print, (told,), {"file": sys.__stderr__, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def named_by_user(name: str, asked: str) -> Any:
    """Import what a user typed as ``module:name``; errors call it `asked`."""
    module, colon, attribute = name.partition(":")
    if not (module and colon and attribute):
        raise RecipeError(f"{asked} cannot be imported: write it as module:name")
    is_by_an_author(module)
    here = str(Path.cwd())
    sys.path.insert(0, here)
    with blaming(part=asked, doing="cannot be imported"):
        try:
            return getattr(importlib.import_module(module), attribute)
        finally:
            sys.path.remove(here)


def _is_authors(names: dict[str, object]) -> bool:
    return package_of(names.get("__name__")) in AUTHORS


def _is_core(names: dict[str, object]) -> bool:
    return package_of(names.get("__name__")) == CORE
