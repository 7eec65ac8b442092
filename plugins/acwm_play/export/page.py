"""Writes the page as files that a browser can open from a disk or any web server.

A page opened from a disk may not fetch files, but it may load scripts. So all other data is
compressed and written as text into scripts.
"""

from __future__ import annotations

import base64
import gzip
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import as_clip
from acwm_core.files import made_whole, writing
from acwm_core.training.run import load_run
from acwm_play.about import about_world, places
from acwm_play.export.episodes import EPISODE_COUNT, RecordedEpisode, maps, record
from acwm_play.export.graphs import check, export_graphs, noise_size
from acwm_play.export.runtime import runtime
from acwm_play.layout import Pointing, controls, physics_of
from acwm_play.live_model import LiveModel
from acwm_play.simulator import Simulator
from acwm_play.worlds import World

PAGE = Path(__file__).parents[1] / "page"

SCRIPTS = ("engine.js", "local.js", "goal.js", "play.js")
"""Scripts of the page, in this order, after its data."""

SERVED = "\n".join(f'<script src="{name}" defer></script>' for name in SCRIPTS[2:])
"""The scripts of the page that is served."""

CHECKED_SECONDS = 4.0
"""Length of the first episode on which the graphs are compared with the model."""


def export(world: World, folder: Path, package: Path | None = None) -> Path:
    """Write the page of a world.

    Args:
        world: world whose model is exported and whose simulator is recorded.
        folder: folder to write, new or empty.
        package: folder of onnxruntime-web; fetched by npm by default.

    Returns:
        The file to open.
    """
    if folder.exists() and any(folder.iterdir()):
        raise RecipeError(f"{folder} is not empty: name a new folder")
    model = load_run(world.run).world_model
    simulator = Simulator(world.environment, world.size)
    try:
        live = LiveModel(model, simulator.card, None)
        graphs = export_graphs(model, world.size)
        parts = {**graphs, **runtime(package)}
        pointing = Pointing.fit(simulator, physics_of(world.environment))
        episodes = [record(simulator, k, live.given, live.stride) for k in range(EPISODE_COUNT)]
        about = _about(world, simulator, live, pointing, episodes)
        about["noise"] = noise_size(model)
    finally:
        simulator.close()
    first, seconds = episodes[0], round(CHECKED_SECONDS * simulator.card.fps / live.stride)
    given = as_clip(first.frames[: live.given])
    actions = first.actions[live.given - 1 :][: live.stride * seconds]
    check(graphs, model, given.numpy(), actions)
    parts["about"] = json.dumps(about).encode()
    parts.update({f"episode{e.index}": e.frames.tobytes() for e in episodes})
    with writing(folder), made_whole(folder) as partial:
        _write(partial, parts)
    return folder / "index.html"


def _about(
    world: World,
    simulator: Simulator,
    live: LiveModel,
    pointing: Pointing | None,
    episodes: list[RecordedEpisode],
) -> dict[str, Any]:
    card = simulator.card
    layout = controls(card, physics_of(world.environment))
    about = about_world(world.name, card, live.stride, layout, pointing)
    rest = episodes[0].stills[0]
    return {
        **about,
        "recorded": True,
        "engine": "from the simulator",
        "drivers": [],
        "tasks": [],
        "metrics": {},
        "why_not": "the page has no estimator",
        "factors": [],
        "asked": {},
        "drawn": {},
        "ood": [],
        "menu": [(world.name, card.name)],
        "rest": rest.tolist(),
        "places": places(pointing, rest),
        "given": live.given,
        "maps": maps(pointing, card.action.low, card.action.high) if pointing else [],
        "episodes": [episode.about() for episode in episodes],
    }


def _write(folder: Path, parts: Mapping[str, bytes]) -> None:
    data = folder / "data"
    data.mkdir()
    for name, content in parts.items():
        text = base64.b64encode(gzip.compress(content, mtime=0)).decode()
        script = f'(window.parts ??= {{}})["{name}"] = "{text}";\n'
        (data / f"{name}.js").write_text(script, encoding="ascii")
    for name in ("play.css", *SCRIPTS):
        shutil.copy(PAGE / name, folder / name)
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    scripts = [*(f"data/{name}.js" for name in parts), *SCRIPTS]
    loads = "\n".join(f'<script src="{script}" defer></script>' for script in scripts)
    for old, new in (
        (SERVED, loads),
        ('<body class="busy">', '<body class="exported recorded busy">'),
    ):
        assert page.count(old) == 1, old
        page = page.replace(old, new)
    (folder / "index.html").write_text(page, encoding="utf-8")
