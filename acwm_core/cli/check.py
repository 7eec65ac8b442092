"""`acwm check`: the conformance suite for parts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any

import click

from acwm_core.errors import RecipeError, UnknownNameError
from acwm_core.registry import KINDS


@click.command()
@click.argument("name")
@click.argument("words", nargs=-1)
def check(name: str, words: tuple[str, ...]) -> None:
    """Check that the part NAME keeps its contract.

    NAME is anything `acwm list` shows. WORDS set its parameters as in a recipe:
    codec.weights=data/wan. Exit code 1 if a check fails.
    """
    from acwm_core.catalog import catalog

    kinds = [kind for kind in KINDS if name in catalog().registry(kind)]
    if not kinds:
        known = {part.name for kind in KINDS for part in catalog().registry(kind)}
        raise UnknownNameError("part", name, known)
    failed = 0
    for kind in kinds:
        parameters = _parameters("env" if kind == "environment" else kind, name, words)
        click.echo(f"{kind} {name}")
        for result in resolve_name(f"acwm_core.checks:check_{kind}")(name, **parameters):
            failed += not result.passed
            click.echo(f"  {result}")
    if failed:
        click.echo(f"{failed} failed", err=True)
        sys.exit(1)


def _parameters(section: str, name: str, words: Sequence[str]) -> dict[str, Any]:
    """The parameters that words set, checked as those of a recipe are."""
    from acwm_core.recipe.compose import PARTS, merge, parse_word
    from acwm_core.recipe.validate import check_part

    given: dict[str, Any] = {}
    for word in words:
        if section not in PARTS or not word.startswith(f"{section}."):
            raise RecipeError(f"{word!r} sets nothing of {name}; write {section}.PARAMETER=VALUE")
        given = merge(given, parse_word(word))
    if not given:
        return {}
    checked = check_part(section, {"name": name, **given[section]})
    return {parameter: checked[parameter] for parameter in given[section]}
