"""The top of the command line: where errors become one sentence and an exit code."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from acwm_core.errors import AcwmError, RenamedWarning

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


class AcwmGroup(click.Group):
    """A command group that ends with one sentence on stderr for whatever a user can fix.

    Exit code 2 for a wrong override, name or file; 130 after Ctrl-C. Anything else that escapes a
    command is a bug and keeps its traceback.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Commands in the order in which one needs them."""
        return list(self.commands)

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> NoReturn:
        """Parse the arguments, run the command and exit."""
        warnings.simplefilter("always", RenamedWarning)
        warnings.showwarning = _show_warning
        try:
            result = super().main(args, *more, **{**extra, "standalone_mode": False})
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            where = error.ctx.command_path if error.ctx else "acwm"
            _fail(f"{error.format_message().rstrip('.')} (see {where} --help)", error.exit_code)
        except click.ClickException as error:
            _fail(error.format_message(), error.exit_code)
        except AcwmError as error:
            _fail(str(error), error.exit_code)
        except (KeyboardInterrupt, click.Abort):
            _fail("stopped", INTERRUPTED)
        sys.exit(result if isinstance(result, int) else 0)


_show_any_warning = warnings.showwarning


def _show_warning(
    message: Warning | str, category: type[Warning], *more: Any, **extra: Any
) -> None:
    """Show an old spelling as one sentence, and other warnings as Python does."""
    if issubclass(category, RenamedWarning):
        click.echo(f"acwm: warning: {message}", err=True)
    else:
        _show_any_warning(message, category, *more, **extra)


def _fail(message: str, exit_code: int) -> NoReturn:
    click.echo(f"acwm: {' '.join(message.split())}", err=True)
    sys.exit(exit_code)
