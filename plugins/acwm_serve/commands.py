"""`acwm serve`: a model for robots and other programs."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import RUN
from acwm_core.errors import RecipeError
from acwm_core.training.threads import wait_without_spinning

COUNT, SECONDS = click.IntRange(1), click.FloatRange(0.001)


@click.command()
@click.argument("run", type=RUN)
@click.option("--task", metavar="NAME", help="Task whose distance to a goal clients may ask for.")
@click.option("--steps", type=COUNT, help="Sampling steps; the recipe's by default.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to serve at.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8427, show_default=True, help="0: any free."
)
@click.option(
    "--token", envvar="ACWM_SERVE_TOKEN", help="What clients must send; a new one by default."
)
@click.option("--sessions", type=COUNT, default=64, show_default=True, help="Most clients at once.")
@click.option("--queue", type=COUNT, default=64, show_default=True, help="Most waiting requests.")
@click.option(
    "--batch", type=COUNT, default=64, show_default=True, help="Most requests in a forward pass."
)
@click.option(
    "--timeout", type=SECONDS, default=30.0, show_default=True, help="Seconds a request may wait."
)
@click.option(
    "--idle", type=SECONDS, default=300.0, show_default=True, help="Seconds a session may be idle."
)
def serve(
    run: Path,
    task: str | None,
    steps: int | None,
    host: str,
    port: int,
    token: str | None,
    **limits: Any,
) -> None:
    """Serve the model of RUN over a websocket.

    A client sends first frames and then actions, and receives the predicted frames. Requests of
    several clients are predicted together. /health and /metrics report the server's state. Ctrl-C
    stops it.
    """
    wait_without_spinning()
    if token is not None and not (token.isascii() and token.isprintable() and len(token) >= 16):
        raise RecipeError("--token: at least 16 plain characters, or leave it out for a new one")
    from acwm_serve.engine import Engine
    from acwm_serve.server import Limits, serve

    engine = Engine(run, task=task, steps=steps)
    if not engine.joins:
        click.echo("this model's streams cannot be joined: requests are computed one by one")
    serve(engine, token or secrets.token_urlsafe(32), Limits(**limits), host=host, port=port)
