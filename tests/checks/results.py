"""Reading results of checks in tests."""

from collections.abc import Iterable

from acwm_core.checks import CheckResult
from acwm_core.checks.result import checks_of
from acwm_core.plugins import Component, catalog


def in_words(check) -> str:
    """The name under which a check function reports."""
    return check.__name__.replace("_", " ")


def only_run(name, monkeypatch):
    """Leave out the checks of suites but the one of that name, and the first, which may end all."""

    def kept(suite):
        first, *others = checks_of(suite)
        return [first, *(check for check in others if in_words(check) == name)]

    monkeypatch.setattr("acwm_core.checks.result.checks_of", kept)


def failures(results: Iterable[CheckResult]) -> dict[str, str]:
    """The reason of each failed check by its name."""
    return {result.name: result.reason for result in results if not result.passed}


def installed(kind) -> list[Component]:
    """The components that can be used and come from an installed plugin, not from another test."""
    components = catalog().registry(kind)
    return [
        component
        for component in components
        if component.distribution
        and not component.missing_modules()
        # Those that only read runs of earlier versions are the same under another name.
        and ".former:" not in component.target
    ]


class Flaws(dict):
    """Flawed classes, each with the check that must fail on it and a phrase of what it says.

    Args:
        suite: what checks them; none if the tests of the suite do it themselves.
        checks: those of the suite.
        *arguments: of the suite, beside the class.
    """

    def __init__(self, suite=None, checks=(), *arguments):
        super().__init__()
        self.suite, self.all, self.arguments = suite, checks, arguments

    def caught_by(self, check, reason):
        """Decorate a flawed class."""

        def note(flawed):
            self[flawed] = check, reason
            return flawed

        return note

    def checks(self):
        """The checks that have a flaw to find."""
        return {check for check, _ in self.values()}
