"""`acwm check`: the conformance suite for parts."""

from __future__ import annotations

import sys
from pkgutil import resolve_name

import click

from acwm_core.errors import UnknownNameError
from acwm_core.registry import KINDS


@click.command()
@click.argument("name")
def check(name: str) -> None:
    """Check that the part NAME keeps its contract.

    NAME is anything `acwm list` shows. Exit code 1 if a check fails.
    """
    from acwm_core.catalog import catalog

    kinds = [kind for kind in KINDS if name in catalog().registry(kind)]
    if not kinds:
        known = {part.name for kind in KINDS for part in catalog().registry(kind)}
        raise UnknownNameError("part", name, known)
    failed = 0
    for kind in kinds:
        click.echo(f"{kind} {name}")
        for result in resolve_name(f"acwm_core.checks:check_{kind}")(name):
            failed += not result.passed
            click.echo(f"  {result}")
    if failed:
        click.echo(f"{failed} failed", err=True)
        sys.exit(1)
