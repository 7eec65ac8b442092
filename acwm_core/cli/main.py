"""All commands of `acwm`, which import nothing heavy until they run, and where errors end."""

from __future__ import annotations

import contextlib
import io
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

from acwm_core import __version__
from acwm_core.catalog import catalog
from acwm_core.cli.components import check, list_components, show
from acwm_core.cli.evaluate import evaluate
from acwm_core.cli.fit import fit
from acwm_core.cli.generate import generate
from acwm_core.data.atomic import disk_error
from acwm_core.errors import (
    INTERRUPTED,
    AcwmError,
    AcwmWarning,
    PluginError,
    RenamedWarning,
)
from acwm_core.errors.plugin_code import blaming
from acwm_core.untrusted import printable


class AcwmGroup(click.Group):
    """A command group that ends with one sentence on stderr for whatever a user can fix.

    Exit code 2 for a wrong override, name or file; 130 after Ctrl-C. Anything else that escapes a
    command is a bug and keeps its traceback, but for what plugins raise.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Commands in the order in which one needs them, then those of plugins with no place."""
        brought = catalog().registry("command")
        after = {n: str(each.defaults.get("after")) for n, each in brought.components().items()}
        names = dict.fromkeys([*self.commands, *(each.name for each in brought)])

        def followed(name: str) -> Iterator[str]:
            yield name
            for other in reversed([each for each, place in after.items() if place == name]):
                yield from followed(other)

        first = [name for name in names if after.get(name) not in names]
        placed = [each for name in first for each in followed(name)]
        return list(dict.fromkeys([*placed, *names]))  # those that follow each other in a circle

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """That of a plugin is imported now."""
        found, brought = super().get_command(ctx, cmd_name), catalog().registry("command")
        command = brought[cmd_name].load() if found is None and cmd_name in brought else found
        completions = catalog().registry("completion")
        for parameter in command.params if command and ctx.resilient_parsing else ():
            if parameter.name in completions:  # a shell asks
                parameter.shell_complete = completions[parameter.name].load()
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """What plugins raise is told before click takes it for its own."""
        with blaming(leaving=disk_error):
            return super().invoke(ctx)

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> NoReturn:
        """Parse the arguments, run the command and exit."""
        warnings.simplefilter("always", RenamedWarning)
        warnings.showwarning = _show_warning
        _print_anything()
        words = list(sys.argv[1:] if args is None else args)
        shown = "--traceback" in words
        words = [word for word in words if word != "--traceback"]  # wherever it stands
        try:
            with blaming(leaving=disk_error):
                result = super().main(words, *more, **{**extra, "standalone_mode": False})
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            where = error.ctx.command_path if error.ctx else "acwm"
            _fail(f"{error.format_message().rstrip('.')} (see {where} --help)", error.exit_code)
        except click.ClickException as error:
            _fail(error.format_message(), error.exit_code)
        except AcwmError as error:
            if shown:
                traceback.print_exception(error)
            _refuse_a_deleted_folder(error.__cause__)
            hint = isinstance(error, PluginError) and error.__cause__ and not shown
            _fail(f"{error}{'; --traceback shows all of it' if hint else ''}", error.exit_code)
        except (KeyboardInterrupt, click.Abort):
            _fail("stopped", INTERRUPTED)
        except Exception as error:
            _refuse_a_deleted_folder(error)
            if (found := disk_error(error)) is None:
                raise
            where = f"{found.filename}: " if found.filename else ""
            _fail(f"{where}{found.strerror}; make room or allow it, and run the command again", 2)
        sys.exit(result if isinstance(result, int) else 0)


def _print_anything() -> None:
    """Show a question mark in the place of what a terminal does not know, as of ASCII only."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError):  # of a pipe's other end, or a file that was cut
                stream.reconfigure(errors="replace")


def _refuse_a_deleted_folder(error: BaseException | None) -> None:
    """End the command if `error` is that the current folder was deleted: no path leads anywhere."""
    if isinstance(error, FileNotFoundError):
        try:
            Path.cwd()
        except FileNotFoundError:
            _fail("the current folder was deleted; change to another one", 2)


_show_any_warning = warnings.showwarning


def _show_warning(
    message: Warning | str, category: type[Warning], *more: Any, **extra: Any
) -> None:
    if issubclass(category, (AcwmWarning, RenamedWarning)):
        click.echo(f"acwm: warning: {printable(str(message))}", err=True)
    else:
        _show_any_warning(message, category, *more, **extra)


def _fail(message: str, exit_code: int) -> NoReturn:
    click.echo(f"acwm: {printable(' '.join(message.split()))}", err=True)
    sys.exit(exit_code)


_SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True}


@click.group(cls=AcwmGroup, context_settings=_SETTINGS)
@click.version_option(__version__, prog_name="acwm")
@click.option(
    "--traceback", is_flag=True, expose_value=False, help="Show the full traceback of errors."
)
def main() -> None:
    """Action-conditioned video world models: simulate, train, evaluate.

    Start with `acwm demo`: it simulates a small dataset, trains a world model on it and writes a
    report.
    """


for _command in (list_components, show, generate, fit, evaluate, check):
    main.add_command(_command)
