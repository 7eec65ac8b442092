"""Runs checks: methods that return if they pass, or raise `CheckFailure` with a reason."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from acwm_core.errors import noting, sentence
from acwm_core.plugins import catalog

Checked = str | Callable[..., Any]
"""The component to check: a registered name, or the class."""


class CheckFailure(Exception):
    """A check did not pass; the message is one sentence that says why."""


class NotTried(Exception):
    """A check has nothing to try on this component; the message says why."""


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        name: the check in words, e.g. ``"same spec same bytes"``.
        passed: whether the component conforms, or there was nothing to try.
        reason: why it does not, or why there was nothing to try; else empty.
    """

    name: str
    passed: bool
    reason: str = ""

    def __str__(self) -> str:
        """One line, for a terminal or a test's message."""
        if not self.passed:
            return f"FAIL  {self.name}: {self.reason}"
        return (
            f"--    {self.name}: not tried: {self.reason}" if self.reason else f"ok    {self.name}"
        )


def expect(condition: object, reason: str) -> None:
    """Fail the running check with `reason` unless `condition` is true."""
    if not condition:
        raise CheckFailure(reason)


def expect_is_a(value: object, base: type) -> None:
    """Fail the running check unless `value` is an instance of `base`."""
    if not isinstance(value, base):  # texts of large tensors take long
        kind = type(value).__name__
        raise CheckFailure(f"{value!r:.60} is a {kind}, not a {base.__name__}")


def expect_equal(what: str, actual: object, wanted: object) -> None:
    """Fail the running check unless both are equal; e.g. `what` is "masks are"."""
    if actual != wanted:
        raise CheckFailure(f"{what} {actual}, not {wanted}")


def checks_of(suite: type[Suite]) -> tuple[Callable[[Any], None], ...]:
    """The checks of a suite: public methods without parameters, its own before inherited ones."""
    methods = [m for base in suite.__mro__ for m in vars(base).values() if inspect.isfunction(m)]
    public = (m for m in methods if not m.__name__.startswith("_"))
    return tuple(m for m in public if len(inspect.signature(m).parameters) == 1)


def run_checks(suite: Suite) -> Iterator[CheckResult]:
    """Run the checks of a suite in order; if the first one fails, skip the others."""
    for index, check in enumerate(checks_of(type(suite))):
        name = check.__name__.replace("_", " ")
        try:
            with noting(f"in {suite.target.__name__}", suite.target):
                check(suite)
        except (CheckFailure, NotTried) as result:
            yield CheckResult(name, isinstance(result, NotTried), str(result))
        except (Exception, SystemExit) as error:
            yield CheckResult(name, False, sentence(error))
            if index == 0:
                return
        else:
            yield CheckResult(name, True)


class Suite:
    """Checks of a component: public methods without parameters. For the arguments see `check`."""

    kind: str

    def __init__(self, component: Checked, **params: Any) -> None:
        self.name = component if isinstance(component, str) else None
        registered = self.name and catalog().component(self.kind, self.name)
        self.target: Any = registered.load() if registered else component
        create: Any = registered.create if registered else component
        self.make = functools.partial(create, **params)

    @classmethod
    def check(cls, component: Checked, *args: Any, **params: Any) -> Iterator[CheckResult]:
        """Check a component against the contract of its kind.

        Args:
            component: a registered name, or the class.
            *args: for suites that take it, what the component is checked on: a registered name, or
                the class.
            **params: constructor parameters, for instance a small width.
        """
        return run_checks(cls(component, *args, **params))
