"""`acwm new`: a copy of `examples/acwm_pendulum`, which is tested, under a name of one's own."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

import click

from acwm_core.catalog import catalog
from acwm_core.cli.arguments import OUT_FOLDER
from acwm_core.data.atomic import made_whole
from acwm_core.errors import RecipeError

EXAMPLE = "pendulum"

_NAME_IN_CODE = re.compile(
    rf"""(?<=[_."'/]){EXAMPLE}|{EXAMPLE}(?=[_:"'/]|\.py)|(?<=(?:check|erate) ){EXAMPLE}"""
)

_SKIPPED = {"__pycache__", "build", "dist", ".pytest_cache"}


@click.group()
def new() -> None:
    """Start a plugin of your own."""


@new.command()
@click.argument("name")
@click.option("--out", type=OUT_FOLDER, help="Folder to make; acwm_NAME by default.")
def environment(name: str, out: Path | None) -> None:
    """Write a package with an environment called NAME.

    It can be installed and works as it is, a pendulum under your name, with a metric and tests;
    change it piece by piece. NAME is in snake_case.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        raise RecipeError(f"{name!r} cannot name an environment; use snake_case, as in open_drawer")
    if name in catalog().registry("environment"):
        raise RecipeError(f"an environment named {name!r} is installed already; choose another")
    folder = out or Path(f"acwm_{name}")
    if folder.exists():
        raise RecipeError(f"{folder} exists already; choose another --out")
    package = Path(__file__).parents[1]  # in a wheel, examples are in it, in a checkout beside it
    beside = [root / "examples" / f"acwm_{EXAMPLE}" for root in (package, package.parent)]
    example = next(filter(Path.is_dir, beside))
    with made_whole(folder) as made:
        for path in sorted(example.rglob("*")):
            inside = path.relative_to(example)
            skipped = any(p in _SKIPPED or p.endswith(".egg-info") for p in inside.parts)
            if path.is_file() and not skipped:
                target = made / _renamed(str(inside), name)
                target.parent.mkdir(parents=True, exist_ok=True)
                text = _renamed(path.read_text(encoding="utf-8"), name)
                target.write_text(text, encoding="utf-8")
    click.echo(f"made {folder}; next: pip install -e {folder} && acwm check {name}")


def _renamed(text: str, name: str) -> str:
    """Code under the new name; prose still says what the code does, which is to be a pendulum."""
    text = text.replace("Pendulum", "".join(word.capitalize() for word in name.split("_")))
    text = text.replace("angle_error", f"{name}_angle_error")  # names of metrics are unique too
    return _NAME_IN_CODE.sub(name, text)
