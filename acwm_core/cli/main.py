"""The `acwm` command group and its error handling. Commands import heavy modules when they run."""

from __future__ import annotations

import contextlib
import io
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NoReturn

import click

from acwm_core import __version__
from acwm_core.cli.components import check, list_components, show
from acwm_core.cli.doctor import doctor
from acwm_core.cli.fit import fit
from acwm_core.cli.generate import generate
from acwm_core.errors import AcwmError, AcwmWarning, is_for_users, noting, sentence, suggest
from acwm_core.files import disk_error
from acwm_core.interrupts import INTERRUPTED
from acwm_core.plugins import catalog
from acwm_core.recipe.trust import trust_recipes

EXPECTED = {
    "resume": "; to continue a run, type `acwm fit resume=RUN`",
    "train": "; to train a model, type `acwm fit RECIPE`",
    "import": "; to import recordings, type `acwm data import PATH`",
}
"""What to type in place of commands that people expect."""


class AcwmGroup(click.Group):
    """A command group that reports errors a user can fix in one sentence on stderr.

    The exit code is 2 for a wrong override, name or file, and 130 after Ctrl-C. Errors with a note
    that names a component are reported in one sentence, too. Any other error is a bug in acwm and
    keeps its traceback.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Commands in the order of a typical workflow, then commands of plugins without a place."""
        brought = catalog().registry("command")
        commands = brought.components().items()
        after = {name: str(command.defaults.get("after")) for name, command in commands}
        opening = [name for name, place in after.items() if place == "acwm"]
        whole = (command.name for command in brought if "." not in command.name)
        names = dict.fromkeys([*opening, *self.commands, *whole])

        def followed(name: str) -> Iterator[str]:
            yield name
            for other in reversed([other for other, place in after.items() if place == name]):
                yield from followed(other)

        first = [name for name in names if after.get(name) not in names]
        placed = [follower for name in first for follower in followed(name)]
        return list(dict.fromkeys([*placed, *names]))  # `names` adds those that form a circle

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; a command of a plugin is imported now.

        A plugin adds to a group of another one by a name such as ``"data.report"``.
        """
        own, brought = super().get_command(ctx, cmd_name), catalog().registry("command")
        command = brought[cmd_name].load() if own is None and cmd_name in brought else own
        if isinstance(command, click.Group):
            for component in brought:
                group, _, name = component.name.partition(".")
                if name and group == cmd_name:
                    command.add_command(component.load(), name)
        if command and ctx.resilient_parsing:  # shell completion
            from acwm_core.cli.completion import COMPLETIONS

            for parameter in command.params:
                if parameter.name in COMPLETIONS:
                    parameter.shell_complete = COMPLETIONS[parameter.name]
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Find the command; suggests one of all commands, also of plugins, if there is none."""
        names = self.list_commands(ctx)
        if args[0] in names or args[0].startswith("-"):
            return super().resolve_command(ctx, args)
        near = EXPECTED.get(args[0]) or suggest(args[0], names)
        raise click.UsageError(f"there is no command {args[0]!r}{near}", ctx)

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> NoReturn:
        """Parse the arguments, run the command and exit."""
        _warnings.clear()
        warnings.showwarning = _show_warning
        _print_anything()
        words = list(sys.argv[1:] if args is None else args)
        with_traceback = "--traceback" in words
        trust_recipes("--trust-recipe" in words)
        words = [word for word in words if word not in ("--traceback", "--trust-recipe")]
        try:
            with _named_if_of_others(words):
                result = super().main(words, *more, **{**extra, "standalone_mode": False})
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            where = error.ctx.command_path if error.ctx else "acwm"
            _fail(f"{error.format_message().rstrip('.')} (see {where} --help)", error.exit_code)
        except click.ClickException as error:
            _fail(error.format_message(), error.exit_code)
        except (KeyboardInterrupt, click.Abort) as stop:
            if isinstance(stop.__cause__, EOFError):  # click takes it for the end of the input
                _report(stop.__cause__, with_traceback)
            _fail("stopped", INTERRUPTED)
        except Exception as error:
            _report(error, with_traceback)
        sys.exit(result if isinstance(result, int) else 0)


def _named_if_of_others(words: Sequence[str]) -> AbstractContextManager[None]:
    """Add a note to errors in a command that another package brings."""
    name = next((word for word in words if not word.startswith("-")), None)
    command = catalog().registry("command").components().get(name) if name else None
    if command is None or command.distribution == "acwm":
        return contextlib.nullcontext()
    where = f"in {command.part} of plugin {command.plugin!r}"
    return noting(where, command.target, unless=AcwmError)


def _report(error: Exception, with_traceback: bool) -> NoReturn:
    """End the command with a sentence about `error`; raises it if it is a bug in acwm."""
    if with_traceback:
        traceback.print_exception(error)
    _refuse_a_deleted_folder()
    cause = None if isinstance(error, AcwmError) else disk_error(error)
    if cause is not None:
        where = f"{cause.filename}: " if cause.filename else ""
        advice = "free disk space or fix the permissions, and run the command again"
        _fail(f"{where}{cause.strerror}; {advice}", 2)
    if isinstance(error, AcwmError):
        _fail(sentence(error), error.exit_code)
    if not is_for_users(error):
        raise error
    _fail(f"{sentence(error)}{'' if with_traceback else '; --traceback shows all of it'}", 2)


def _print_anything() -> None:
    """Print `?` for characters that the terminal cannot encode, e.g. if it is ASCII-only."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError):  # a closed pipe or a truncated file
                stream.reconfigure(errors="replace")


def _refuse_a_deleted_folder() -> None:
    """End the command if the current folder was deleted, which causes many errors."""
    try:
        Path.cwd()
    except FileNotFoundError:
        _fail("the current folder was deleted; change to another one", 2)


_show_any_warning = warnings.showwarning

_warnings: set[str] = set()
"""Those that this command has shown; each is shown once."""


def _show_warning(
    message: Warning | str, category: type[Warning], *more: Any, **extra: Any
) -> None:
    if not issubclass(category, AcwmWarning):
        _show_any_warning(message, category, *more, **extra)
    elif str(message) not in _warnings:
        _warnings.add(str(message))
        click.echo(f"acwm: warning: {message!s}", err=True)


def _fail(message: str, exit_code: int) -> NoReturn:
    click.echo(f"acwm: {' '.join(message.split())}", err=True)
    sys.exit(exit_code)


_SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True}


@click.group(cls=AcwmGroup, context_settings=_SETTINGS)
@click.version_option(__version__, prog_name="acwm")
@click.option(
    "--traceback", is_flag=True, expose_value=False, help="Show the full traceback of errors."
)
@click.option(
    "--trust-recipe",
    is_flag=True,
    expose_value=False,
    help="Run code that a recipe names, e.g. a callback; names that you type are always run.",
)
def main() -> None:
    """Action-conditioned video world models: simulate, train, evaluate.

    Start with `acwm demo`: it simulates a small dataset, trains a world model on it and writes a
    report.
    """


for _command in (list_components, show, generate, fit, check, doctor):
    main.add_command(_command)
