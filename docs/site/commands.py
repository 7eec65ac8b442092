"""The page of all commands, generated from click."""

import inspect
from collections.abc import Iterator

import click
from tables import cell, code, table

from acwm_core.cli import main


def commands_page() -> str:
    """A table of all commands, and each with its arguments and options."""
    found = list(walk(main, ()))
    rows = [
        (f"[`acwm {' '.join(path)}`](#{_anchor(path)})", cell(each.get_short_help_str(200)))
        for path, each in found
    ]
    parts = [table(("Command", "What it does"), rows)]
    for path, command in found:
        parts += _section(path, command)
    return "\n\n".join(part for part in parts if part)


def walk(
    command: click.Group, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """All commands except groups, each with the words that call it."""
    context = click.Context(command)
    for name in command.list_commands(context):
        found = command.get_command(context, name)
        assert found is not None
        if isinstance(found, click.Group):
            yield from walk(found, (*path, name))
        elif not found.hidden:
            yield (*path, name), found


def _anchor(path: tuple[str, ...]) -> str:
    return "-".join(("acwm", *path))


def _section(path: tuple[str, ...], command: click.Command) -> list[str]:
    words = " ".join(path)
    context = click.Context(command, info_name=f"acwm {words}")
    usage = " ".join([f"acwm {words}", *command.collect_usage_pieces(context)])
    return [
        f"## acwm {words} {{: #{_anchor(path)} }}",
        f"```bash\n{usage}\n```",
        *map(_paragraph, inspect.cleandoc(command.help or "").split("\n\n")),
        table(("Option", "What it does", "Default"), _options(command, context)),
    ]


def _paragraph(text: str) -> str:
    """The paragraphs of a help text; those marked as preformatted for click stay as they are."""
    if text.startswith("\b\n"):
        return f"```text\n{text[2:]}\n```"
    return text.replace("<", "&lt;")


def _options(command: click.Command, context: click.Context) -> Iterator[tuple[str, str, str]]:
    for parameter in command.get_params(context):
        if (
            not isinstance(parameter, click.Option)
            or parameter.hidden
            or "--help" in parameter.opts
        ):
            continue
        extra = parameter.get_help_extra(context)
        names = ", ".join([*parameter.opts, *parameter.secondary_opts])
        taken = "" if parameter.is_flag or parameter.count else parameter.make_metavar(context)
        default = str(extra.get("default", ""))
        yield code(f"{names} {taken}".strip()), cell(parameter.help or ""), code(default)
