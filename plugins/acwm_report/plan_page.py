"""`write_plan_page`: a folder of results of `acwm plan` as a page beside its videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from acwm_core.files import read_json
from acwm_planning.results import PlanTable
from acwm_planning.resumable import SETTINGS_FILE
from acwm_planning.settings import ROW_NAMES, words_of
from acwm_report.page import write_page
from acwm_report.plan_videos import linked_videos
from acwm_report.plans import ROWS, plan_table
from acwm_report.table import Table

PAGE_FILE = "index.html"


def write_plan_page(folder: Path) -> Table:
    """Write the page of a folder of results: its settings, its table, and a link to each video.

    Returns:
        The table that it shows.
    """
    plans = PlanTable.read(folder)
    table = plan_table(plans)
    settings = read_json(folder / SETTINGS_FILE, dict[str, Any], "settings of results")
    videos = {ROWS[row][0]: linked_videos(folder, row, plans.task) for row in ROW_NAMES}
    write_page(
        folder / PAGE_FILE,
        "plan.html.j2",
        title=f"{plans.task} in {plans.environment}",
        settings=" ".join(words_of(settings)),
        table=table,
        videos={title: of_row for title, of_row in videos.items() if of_row},
    )
    return table
