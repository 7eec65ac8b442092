"""Running checks: functions that return, or raise `CheckFailure` with a reason."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from acwm_core.catalog import catalog
from acwm_core.registry import ComponentKind

Trial = TypeVar("Trial")


class CheckFailure(Exception):
    """A check did not pass; the message is one sentence that says why."""


@dataclass(frozen=True)
class CheckResult:
    """What came of one check.

    Attributes:
        name: the check in words, e.g. ``"same spec same bytes"``.
        passed: whether the component conforms.
        reason: one sentence if it does not; else empty.
    """

    name: str
    passed: bool
    reason: str = ""

    def __str__(self) -> str:
        """One line, for a terminal or a test's message."""
        return f"ok    {self.name}" if self.passed else f"FAIL  {self.name}: {self.reason}"


def expect(condition: object, reason: str) -> None:
    """Go on if `condition` is true, else fail the running check for `reason`."""
    if not condition:
        raise CheckFailure(reason)


def expect_is_a(value: object, base: type) -> None:
    """Go on if `value` is an instance of `base`, else fail the running check."""
    expect(
        isinstance(value, base), f"{value!r:.60} is a {type(value).__name__}, not a {base.__name__}"
    )


def checks_of(suite: type[Trial]) -> tuple[Callable[[Trial], None], ...]:
    """The checks of a suite, in order: the public methods that its class itself defines."""
    methods = vars(suite).items()
    return tuple(m for name, m in methods if inspect.isfunction(m) and not name.startswith("_"))


def run_checks(checks: Sequence[Callable[[Trial], None]], trial: Trial) -> Iterator[CheckResult]:
    """Run every check on `trial` and yield its result, in order.

    The first is the condition of all others: if it fails, they are not tried. An exception other
    than `CheckFailure` fails the check that it escapes from.
    """
    for index, check in enumerate(checks):
        name = check.__name__.replace("_", " ")
        try:
            check(trial)
        except CheckFailure as failure:
            yield CheckResult(name, False, str(failure))
        except Exception as error:
            yield CheckResult(name, False, f"{type(error).__name__}: {error}".rstrip(": "))
        else:
            yield CheckResult(name, True)
            continue
        if index == 0:
            return


def factory(kind: ComponentKind, component: str | Callable[..., Any]) -> Callable[..., Any]:
    """What constructs `component`: a class or function as it is, a name through the catalog.

    Raises:
        UnknownNameError: no component of that kind has that name.
        MissingExtraError, PluginError: it cannot be imported.
    """
    if not isinstance(component, str):
        return component
    found = catalog().component(kind, component)
    found.load()
    return found.create
