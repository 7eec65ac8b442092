"""`write_report`, `export_report`: evaluated runs as one HTML file, or as tables and figures."""

from __future__ import annotations

import base64
import functools
import hashlib
import itertools
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import acwm_core
from acwm_core.errors import DataError
from acwm_core.files import writable, written_whole
from acwm_experiment.table import Experiment
from acwm_report import charts, plans, rankings, tables, titles
from acwm_report.comparison import run_labels
from acwm_report.experiment import experiment_tables
from acwm_report.export import file_name, templates, to_csv, to_latex, to_markdown
from acwm_report.figures import Chart
from acwm_report.opening import main_figures, opening, tracked
from acwm_report.plan_videos import VideoRoom, plan_videos, task_videos
from acwm_report.reproduce import commands
from acwm_report.run import EvaluatedRun, of_readable, read_runs
from acwm_report.scores import main_table
from acwm_report.table import Table
from acwm_report.tracks import tracks
from acwm_report.videos import MEGABYTES, action_traces, embed_videos

FORMATS = {".csv": to_csv, ".md": to_markdown, ".tex": to_latex}

CHARTS: Mapping[str, Callable[[EvaluatedRun], list[Chart]]] = {
    "horizon": lambda run: charts.horizon_charts(run, run.summary.headline),
    "states": charts.state_horizon_charts,
    "pairs": charts.pair_charts,
    "responses": charts.response_charts,
    "predictability": charts.predictability_charts,
    "severity": charts.severity_charts,
    "steps": charts.steps_charts,
    "policies": rankings.ranking_charts,
    "training": charts.training_charts,
}
"""Functions that make the charts of a run, keyed by section of the page."""

TABLES: Mapping[str, Callable[[EvaluatedRun], list[Table]]] = {
    "scores": tables.score_tables,
    "states": tables.state_tables,
    "responses": tables.response_tables,
    "ensembles": tables.ensemble_tables,
    "labels": tables.label_tables,
    "policies": rankings.ranking_tables,
    "plans": plans.plan_tables,
}
"""Functions that make the tables of a run, keyed by section; without the table of all clips."""


def write_report(
    runs: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    megabytes: float = MEGABYTES,
    experiment: Experiment | None = None,
) -> Path:
    """Write a report of evaluated runs.

    The file embeds its videos, charts, style and script and loads nothing else. It can be mailed,
    put online, or opened offline.

    Args:
        runs: their folders; there may be none if the experiment has plans.
        out: the ``.html`` to write; ``report.html`` in the first run's folder by default.
        megabytes: most megabytes of video to embed; other videos stay in the run folders.

    Returns:
        The path of the file.
    """
    folders = _checked(runs, experiment)
    out = writable(Path(out) if out else folders[0] / "report.html", option="--out")
    return _write_text(out, of_readable(folders, partial(_drawn, megabytes, experiment)))


def _drawn(
    megabytes: float,
    experiment: Experiment | None,
    folders: Sequence[Path],
    broken: Mapping[Path, str],
) -> str:
    """Draw the page of the readable runs; it says why the others cannot be read."""
    found, experiment = _read(folders), experiment and experiment.of_runs(folders)
    many = len(found) > 3  # then each run's section is folded up
    videos = embed_videos(found, megabytes)
    used = sum(len(video.data) for each in videos for video in each) / 1e6
    room = VideoRoom(megabytes - used)
    return drawn_page(
        "report.html.j2",
        broken=broken,
        runs=found,
        all_videos=videos,
        all_plan_videos=plan_videos(found, room),
        tasks=plans.task_tables(experiment),
        task_videos=task_videos(experiment, found, room),
        names=_labels(found),
        main=_main_table(found, experiment),
        differences=_differences(found),
        experiment=_experiment_tables(found, experiment),
        opened=1 if many or experiment is not None else len(found),
        title=experiment.title if experiment else f"{len(found)} runs compared",
        folded=many or experiment is not None,
        tables=TABLES,
        charts=CHARTS,
    )


def export_report(
    runs: Sequence[str | Path], folder: str | Path, experiment: Experiment | None = None
) -> list[Path]:
    """Write the tables of a report as CSV, Markdown and LaTeX, and its figures as PNG and PDF.

    With several runs, the files of each run go into a folder of their own.

    Args:
        folder: gets the subfolders ``tables`` and ``figures``; files of the same name are replaced.

    Returns:
        The paths of the files.
    """
    folder = Path(folder)
    for name in ("tables", "figures"):
        writable(folder / name, folder=True)
    return of_readable(_checked(runs, experiment), partial(_exported, folder, experiment))


def _exported(
    folder: Path,
    experiment: Experiment | None,
    runs: Sequence[Path],
    _broken: Mapping[Path, str],
) -> list[Path]:
    found, experiment = _read(runs), experiment and experiment.of_runs(runs)
    made = [_main_table(found, experiment), *_experiment_tables(found, experiment)]
    made += [*plans.task_tables(experiment), _differences(found)]
    written = _export(folder, [each for each in made if isinstance(each, Table)])
    names = _labels(found) if len(found) != 1 else [""]
    for name, each in zip(names, found, strict=True):
        own = [table for make in TABLES.values() for table in make(each)]
        figures = [chart for make in CHARTS.values() for chart in make(each)]
        own.append(tables.episode_table(each))
        written += _export(
            folder / file_name(name) if name else folder, own, figures, f"{each.key}-"
        )
    return written


def _checked(runs: Sequence[str | Path], experiment: Experiment | None) -> list[Path]:
    if not runs and not (experiment and experiment.plans):
        raise DataError("a report needs at least one run: name its folder")
    return [Path(run) for run in runs]


def _read(folders: Sequence[Path]) -> list[EvaluatedRun]:
    """Read the runs; an experiment of plans alone has none."""
    return read_runs(folders) if folders else []


def _labels(runs: Sequence[EvaluatedRun]) -> list[str]:
    return run_labels([each.folder for each in runs]) if runs else []


def _experiment_tables(runs: Sequence[EvaluatedRun], experiment: Experiment | None) -> list[Table]:
    links = {each.folder: each.key for each in runs}
    return experiment_tables(experiment, links) if runs else []


def _main_table(runs: Sequence[EvaluatedRun], experiment: Experiment | None) -> Table | None:
    """The main table; None if the experiment's own table is the same."""
    same = experiment is not None and experiment.table == "main"
    return None if same or not runs else main_table(runs)


def _differences(runs: Sequence[EvaluatedRun]) -> Table | str | None:
    """Differences between several runs of one environment, or the reason why there are none."""
    several = len(runs) > 1 and len({each.summary.parts["env"] for each in runs}) == 1
    return tables.difference_table(runs) if several else None


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Write a page, completely or not at all. Everything that it shows is escaped."""
    return _write_text(writable(path), drawn_page(template, **content))


def drawn_page(template: str, **content: Any) -> str:
    """Render a page. All content is escaped; it runs only its own script and loads nothing."""
    text: str = _page_templates().get_template(template).render(**content)
    (script,) = re.findall(r"<script>(.*)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return text.replace("SCRIPT-DIGEST", f"sha256-{digest}", 1)


@functools.cache  # the page of a plan is written after every episode
def _page_templates() -> Any:
    pages = templates(autoescape=True)
    pages.filters["quote"] = shlex.quote
    pages.globals.update(
        action_traces=action_traces,
        branch_title=titles.branch_title,
        commands_of=commands,
        counted=titles.counted,
        episode_table=tables.episode_table,
        label_title=titles.label_title,
        outdated_curves=charts.outdated_curves,
        figures_of=main_figures,
        opening_of=opening,
        split_title=titles.split_title,
        tracked_of=tracked,
        tracks_of=tracks,
        version=acwm_core.__version__,
    )
    return pages


def _export(
    folder: Path, made: Sequence[Table], figures: Sequence[Chart] = (), prefix: str = ""
) -> list[Path]:
    written: list[Path] = []
    for table, (ending, text) in itertools.product(made, FORMATS.items()):
        written.append(
            _write_text(folder / "tables" / f"{file_name(table.name)}{ending}", text(table))
        )
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    for chart, ending in itertools.product(figures, (".png", ".pdf")):
        name = f"{file_name(chart.name.removeprefix(prefix))}{ending}"
        written.append(folder / "figures" / name)
        chart.save(written[-1])
    return written


def _write_text(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path
