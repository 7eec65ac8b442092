"""`acwm data`: inspect, check, import and export datasets."""

from __future__ import annotations

import inspect
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, cast, get_args, get_origin

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER, numbers, size
from acwm_core.cli.tables import print_table
from acwm_core.errors import DataError, unknown_name
from acwm_formats.options import OPTIONS, import_options

if TYPE_CHECKING:
    from acwm_core.plugins import Registry
    from acwm_formats.format import Format


@click.group()
def data() -> None:
    """Inspect, check, import and export datasets."""


@data.command()
@click.argument("path", type=DATASET)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def info(path: Path, as_json: bool) -> None:
    """Describe the dataset PATH, complete or not."""
    from acwm_formats.preview import describe

    facts = describe(path)
    if as_json:
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        _print_facts(facts)


@data.command()
@click.argument("path", type=DATASET)
@click.option("--out", type=OUT_FOLDER, help="Folder; PATH/preview by default.")
@click.option("--episodes", type=click.IntRange(1), default=4, help="Number of episodes per split.")
def preview(path: Path, out: Path | None, episodes: int) -> None:
    """Draw the first episodes as a picture and a video."""
    from acwm_formats.preview import preview as draw

    for file in draw(path, out or path / "preview", episodes=episodes):
        click.echo(file)


@data.command()
@click.argument("path", type=DATASET)
@click.option(
    "--replays",
    type=click.IntRange(0),
    default=2,
    help="Number of episodes per split to simulate again.",
)
def check(path: Path, replays: int) -> int:
    """Verify a dataset and simulate some episodes again.

    Verifies checksums and contents of PATH, and compares some episodes with new simulations. Exit
    code 1 if something is wrong.
    """
    from acwm_formats.check import check_dataset

    failed = 0
    for finding in check_dataset(path, replays=replays):
        failed += finding.problem is not None
        click.echo(str(finding))
    if failed:
        click.echo(f"{failed} failed", err=True)
    return int(failed > 0)


@data.command("label")
@click.argument("path", metavar="DATA", type=DATASET)
@click.option("--from", "labelled", type=DATASET, help="Dataset with recorded actions.")
@click.option(
    "--latent",
    type=click.IntRange(1, 8),
    metavar="N",
    help="Learn latent actions of N integers from the videos alone.",
)
@click.option("--out", type=OUT_FOLDER, required=True, help="Data folder to create.")
@click.option(
    "--steps", type=click.IntRange(1), default=1500, show_default=True, help="Training steps."
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of weights and order.")
@click.option(
    "--least",
    type=click.FloatRange(0, 1),
    default=0.0,
    help="Mean confidence below which an episode is left out.",
)
def label_data(
    path: Path, labelled: Path | None, latent: int | None, out: Path, least: float, **options: Any
) -> None:
    """Read the actions of the episodes of DATA from their videos.

    An inverse dynamics model learns from the episodes of --from which action lies between frames.
    The new dataset has the recorded episodes and the labelled ones; its card lists which are which,
    and its state has the confidence of every action. Actions in DATA are ignored.

    With --latent, where no actions were recorded at all, the new dataset has the episodes of DATA
    with latent actions: integers from -2 to 2 that describe what happens between two frames. Then
    --from is optional: a map from latent to recorded actions is fitted to its episodes.
    """
    if latent is not None:
        if least:
            raise click.UsageError("--least needs labels with a confidence: leave out --latent")
        _label_latent(path, out, latent, labelled, **options)
    elif labelled is None:
        raise click.UsageError("give --from LABELLED, or --latent N if no actions were recorded")
    else:
        _label(path, labelled, out, least=least, **options)


def _label(path: Path, labelled: Path, out: Path, **options: Any) -> None:
    from acwm_formats.inverse.label import label

    done = label(path, labelled, out, **options)
    quality, action = done.quality, done.card.environment.action
    click.echo(f"actions of {quality.episodes} held-out recorded episodes, read from their videos:")
    rows = zip(action.names, action.units, quality.explained, quality.error, strict=True)
    for name, unit, share, error in rows:
        click.echo(_explained(name, share, f", error {error:.3g} {unit}"))
    halves = f"{quality.surer:.2f} where it is surer, {quality.less_sure:.2f} elsewhere"
    click.echo(f"  mean R² {quality.mean:.2f}: {halves}")
    mean = sum(done.confidence) / len(done.confidence)
    count = len(done.confidence)
    click.echo(f"labelled {count} episode{'s' * (count != 1)}, mean confidence {mean:.2f}")
    if done.left_out:
        click.echo(f"left out {done.left_out} episodes of less confidence")
    click.echo(f"{out} holds {done.card.splits['train']} training episodes")
    if quality.mean < 0.5:
        click.echo("less than half is explained: label more episodes, or raise --steps")


def _label_latent(
    path: Path, out: Path, dimensions: int, labelled: Path | None, **options: Any
) -> None:
    from acwm_formats.inverse.latent_label import label_latent

    done = label_latent(path, out, dimensions, labelled, **options)
    quality, decoder = done.quality, done.decoder
    click.echo(
        f"changes between frames of {quality.episodes} held-out episodes: {quality.explained:.0%} "
        f"predicted with their latent actions, {quality.shuffled:.0%} with those of other moments"
    )
    click.echo(f"of {quality.possible} codes, {quality.codes:.1f} are in effective use")
    if quality.collapsed:
        click.echo(
            "the latent actions have collapsed: nearly all moments have one code, so they say "
            "nothing; raise --steps, or choose another --seed"
        )
    if decoder is not None:
        click.echo(
            f"recorded actions of {decoder.episodes} held-out episodes, from latent ones by a "
            f"linear map that was fitted to {decoder.recorded} others:"
        )
        action = zip(done.card.source["action_decoder"]["actions"], decoder.explained, strict=True)
        for name, share in action:
            click.echo(_explained(name, share))
        if decoder.mean < 0.5:
            click.echo(
                "less than half is explained: what torques or absolute targets do depends on the "
                "scene, which a map of latent actions alone does not know"
            )
    click.echo(f"{out} holds {done.card.splits['train']} training episodes")
    click.echo(f"next: acwm fit small {shlex.quote(f'data.path={out}')}")


def _explained(name: str, share: float, error: str = "") -> str:
    """A line with the R² of a dimension of the action."""
    return f"  {name}: {'never changes' if share != share else f'R² {share:.2f}{error}'}"


def _print_facts(facts: dict[str, Any]) -> None:
    from rich.console import Console

    height, width = facts["frame_size"]
    click.echo(f"{facts['path']}: {facts['environment']}, {facts['summary']}")
    lengths = [n for split in facts["splits"].values() for n in split["lengths"]]
    low, high = (min(lengths), max(lengths)) if lengths else (facts["horizon"],) * 2
    long = f"{low}" if low == high else f"{low} to {high}"
    click.echo(f"{height}×{width} at {facts['fps']:.6g} fps, {long} frames per episode")
    if facts["source"]:
        click.echo(f"recorded: {facts['source']['name']} ({facts['source']['kind']})")
        _print_notes(facts["source"])
    else:
        click.echo(f"seed {facts['seed']}, factors {facts['factors'] or 'as set by the splits'}")
        if facts["exploration"]:
            how = f"exploratory, shifted by up to {facts['shift']:g}"
            how = how if facts["shift"] else "exploratory"
            click.echo(f"{facts['exploration']:.0%} of the training episodes are {how}")
    columns = ("episodes", "made", "shards", "frames")
    rows = [
        (name, [*(str(split[c]) for c in columns), f"{split['bytes'] / 1e6:.1f}"])
        for name, split in facts["splits"].items()
    ]
    console = Console(highlight=False, markup=False)
    print_table(console, None, (*columns, "MB"), rows, first="split")
    for name, split in facts["splits"].items():
        for label, count in split.get("ood_labels", {}).items():
            click.echo(f"{name}: {count} episode{'s' * (count != 1)}, shift {label}")


def _print_notes(source: Mapping[str, Any]) -> None:
    for note in source.get("notes", ()):
        click.echo(f"  {note}")
    for problem in source.get("skipped", ()):
        click.echo(f"  left out: {problem}")


class FormatGroup(click.Group):
    """Has one command per registered format, with the options of its method and those of `base`.

    The format may also be given by ``--format``, after what is imported or exported.

    Args:
        method: `read` or `write`.
        base: called with the format, a dict of the method's parameters, and the options of `base`.
    """

    def __init__(self, method: str, base: click.Command) -> None:
        super().__init__(base.name, help=base.help, subcommand_metavar="[FORMAT] PATH [OPTIONS]")
        self._method, self._base = method, base

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of the formats that can be read, or written, as far as it is known."""
        return [f.name for f in _formats() if f.needs or self._can(f.load())]

    def _can(self, target: Any) -> bool:
        """Whether a format has the method of this command."""
        return getattr(target, f"{self._method}s")()

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List all formats without importing them; their summaries say which are only read."""
        with formatter.section("Formats"):
            formatter.write_dl([(f.name, f.summary) for f in _formats()])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the format first: the one of ``--format``, or the one that the path is in."""
        name, rest = _chosen_format([self._local(word) for word in args])
        if name is None and rest and not rest[0].startswith("-") and rest[0] not in _formats():
            name = self._found(rest[0])
        return super().parse_args(ctx, [name, *rest] if name else rest)

    def _local(self, word: str) -> str:
        """Fetch what a URL stands for; other words stay."""
        from acwm_formats.sources import fetched, is_url

        return str(fetched(word)) if self._method == "read" and is_url(word) else word

    def _found(self, path: str) -> str:
        from acwm_formats.format import detected_format

        if self._method == "write":
            known = ", ".join(self.list_commands(click.Context(self)))
            raise unknown_name("format", path, _formats().components(), f"(one of {known})")
        if not Path(path).exists():
            return path  # it is meant as a name: `get_command` suggests the closest
        name = detected_format(Path(path))
        click.echo(f"{path} is in the format {name}")
        return name

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        """The command of a format; `RecipeError` suggests the closest name."""
        from acwm_formats.format import options_of

        component = _formats()[cmd_name]
        target = component.load()
        if not self._can(target):
            done = {"read": "imported", "write": "exported"}
            other = done["write" if self._method == "read" else "read"]
            raise DataError(f"{cmd_name} can only be {other}, not {done[self._method]}")
        method = getattr(target, self._method)
        own = [_parameter(*option) for option in options_of(method)]

        def run(**values: Any) -> None:
            options = {str(option.name): values.pop(str(option.name)) for option in own}
            if self._base.callback:
                self._base.callback(component.create(), options, **values)

        params = sorted([*own, *self._base.params], key=lambda p: isinstance(p, click.Option))
        text = (inspect.getdoc(method) or "").partition("\nArgs:")[0]
        return click.Command(cmd_name, params=params, callback=run, help=text)


def _formats() -> Registry:
    from acwm_core.plugins import catalog

    return catalog().registry("format")


def _chosen_format(args: list[str]) -> tuple[str | None, list[str]]:
    """The value of ``--format`` in `args`, if it is there, and the other arguments."""
    for place, word in enumerate(args):
        if word == "--format" and place + 1 < len(args):
            return args[place + 1], [*args[:place], *args[place + 2 :]]
        if word.startswith("--format="):
            return word.partition("=")[2], [*args[:place], *args[place + 1 :]]
    return None, args


def _parameter(parameter: inspect.Parameter, text: str) -> click.Parameter:
    name, default = parameter.name, parameter.default
    settings: dict[str, Any] = {"type": _click_type(parameter.annotation)}
    if default is parameter.empty:
        settings["required"] = True
    elif isinstance(default, tuple):  # as a user would type it
        joint = "x" if settings["type"] is size else ","
        settings["default"] = joint.join(map(str, cast(tuple[int, ...], default)))
    else:
        settings["default"] = default
    if parameter.kind is not parameter.KEYWORD_ONLY:
        return click.Argument([name], **settings)
    word = name.replace("_", "-")
    spelt = f"--{word}/--no-{word}" if parameter.annotation is bool else f"--{word}"
    return click.Option([spelt], **settings, show_default=default is not None, help=text)


def _click_type(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, UnionType):
        kinds = {*get_args(annotation)} - {NoneType}
        return size if kinds == {int, tuple[int, int]} else _click_type(kinds.pop())
    if get_origin(annotation) is Literal:
        return click.Choice(get_args(annotation))
    known = {tuple[int, ...]: numbers, Path: click.Path(path_type=Path)}
    return known.get(annotation, annotation)


@click.command("import")
@click.option("--out", type=OUT_FOLDER, required=True, help="Data folder to create.")
@click.option("--workers", type=int, help="Processes; one per core by default, 0 for none.")
def import_format(
    source: Format, given: dict[str, Any], out: Path, workers: int | None, **asked: Any
) -> None:
    """Import recordings in another format as a dataset.

    Without FORMAT or --format FORMAT, the format is detected from the files. If it is interrupted,
    run the same command again to continue.
    """
    from acwm_formats.recordings import import_dataset
    from acwm_formats.sizes import small_size
    from acwm_formats.survey.survey import short_form, survey
    from acwm_formats.timeline import RecordedDataset

    options = import_options(**asked)
    recorded = source.read(**given)
    datasets = {".": recorded} if isinstance(recorded, RecordedDataset) else recorded
    if options.environment and len(datasets) > 1:
        raise DataError(
            f"--environment {options.environment} would give {len(datasets)} datasets the "
            "same name: import one folder at a time, or omit it"
        )
    for name, dataset in datasets.items():
        card = import_dataset(dataset, out / name, options, workers=workers)
        counts = ", ".join(f"{count} {split}" for split, count in card.splits.items())
        click.echo(f"{out / name} holds {counts} episodes of {card.environment.name}")
        _print_notes(card.source)
        for line in short_form(survey(out / name)):
            click.echo(line)
        height, width = card.environment.frame_size
        camera = height, width // max(1, len(card.environment.views))
        if (smaller := small_size(camera)) != camera:
            click.echo(
                f"· frames of {camera[0]}×{camera[1]} train slowly: the "
                f"recipe small is made for --size {smaller[0]}x{smaller[1]}"
            )
        click.echo(f"next: acwm fit small {shlex.quote(f'data.path={out / name}')}")


import_format.params += OPTIONS


@click.command("export")
@click.argument("data", type=DATASET)
@click.option("--out", type=OUT_FOLDER, required=True, help="Folder to create.")
def export_format(target: Format, given: dict[str, Any], data: Path, out: Path) -> None:
    """Export a dataset to another format, given as FORMAT or by --format FORMAT."""
    from acwm_formats.format import export_dataset

    click.echo(f"wrote {export_dataset(data, out, target, **given)}")


data.add_command(FormatGroup("read", import_format))
data.add_command(FormatGroup("write", export_format))
