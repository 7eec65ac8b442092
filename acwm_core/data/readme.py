"""The page that a dataset hub shows of a dataset."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, cast

import yaml

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import Manifest
from acwm_core.files import written_whole

README = "README.md"
MARK = "<!-- Made by acwm from card.yaml. Without this line acwm leaves the page as it is. -->"
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""Upper bounds of the Hugging Face hub's size categories, in episodes."""


def write_readme(folder: Path, card: DatasetCard) -> None:
    """Write ``folder/README.md`` for the finished splits, unless a user removed its `MARK`.

    A dataset hub shows it: YAML for the hub, then Markdown for people. Equal datasets get equal
    pages.
    """
    path = folder / README
    if path.exists() and MARK.encode() not in path.read_bytes():
        return
    page = _template().render(
        card=card,
        environment=card.environment,
        splits={split: Manifest(folder / split).ordered() for split in card.splits},
        statistics=card.actions.get("train") or next(iter(card.actions.values()), None),
        front_matter=_front_matter(card),
        mark=MARK,
    )
    with written_whole(path) as partial:
        partial.write_text(page, encoding="utf-8")


@functools.cache
def _template() -> Any:
    import jinja2

    def cell(text: object) -> str:
        return str(text).replace("|", "\\|").replace("\n", " ")

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("acwm_core.data", "."),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    cast(Any, pages).filters["cell"] = cell
    return pages.get_template("readme.md.j2")


def _front_matter(card: DatasetCard) -> str:
    """The YAML header that the Hugging Face hub reads."""
    environment = card.environment
    height, width = environment.frame_size
    total = sum(card.splits.values())
    files = [{"split": split, "path": f"{split}/*.tar"} for split in card.splits]
    engine = [] if card.source else ["simulation", environment.engine.lower().replace(" ", "-")]
    values = {
        "pretty_name": f"{environment.name}, {height}×{width}",
        "license": "unknown",
        "task_categories": ["robotics", "image-to-video"],
        "tags": ["world-model", "action-conditioned", "video", *engine, "webdataset", "acwm"],
        "size_categories": [next((name for top, name in SIZES if total < top), "n>1M")],
        "configs": [{"config_name": "default", "data_files": files}],
    }
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
