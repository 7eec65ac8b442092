"""``README.md`` of a data folder: what a dataset hub shows of it, made of card and manifests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from acwm_core.data.atomic import written_whole
from acwm_core.data.card import DatasetCard
from acwm_core.data.manifest import Manifest
from acwm_core.environment import EnvironmentCard
from acwm_core.episode import Factor, Split

README = "README.md"

MARK = "<!-- Made by acwm from card.yaml. Without this line acwm leaves the page as it is. -->"

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""Bounds of the hub's size categories, in episodes."""

MEMBERS = (
    ("video.mkv", "lossless H.264 in RGB, `[T, H, W, 3]` uint8"),
    ("mask.mkv", "lossless FFV1 of instance ids, `[T, H, W]` uint8"),
    ("actions.npy", "float32 `[T, A]`, raw units; row i takes frame i to i + 1, the last is zero"),
    ("states.npz", "one array `[T, …]` per state field"),
    ("contacts.npy", "int32 rows (frame, id, id) of what touches"),
    ("json", "spec, factors, `ood_label`, versions, CRC-32 of the other members"),
)

Manifests = dict[Split, Manifest]
Rows = Iterable[Sequence[object]]


def write_readme(folder: Path, card: DatasetCard) -> None:
    """Write ``folder/README.md`` for the finished splits, unless somebody made it their own.

    Args:
        folder: a data folder, with its card.
        card: that card.
    """
    path = folder / README
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return
    manifests: Manifests = {split: Manifest(folder / split) for split in card.splits}
    with written_whole(path) as partial:
        partial.write_text(readme(card, manifests), encoding="utf-8")


def readme(card: DatasetCard, manifests: Manifests) -> str:
    """The page: YAML for a hub, then Markdown for people. The same for equal datasets."""
    environment = card.environment
    parts = [
        f"---\n{yaml.safe_dump(_metadata(card), sort_keys=False, allow_unicode=True)}---\n\n{MARK}",
        f"# {environment.name}",
        _introduction(card),
        _splits(card, manifests),
        _actions(card),
        _factors(card),
        _state(environment),
        _format(environment),
        _loading(card),
        _making(card),
        _citation(environment),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _metadata(card: DatasetCard) -> dict[str, Any]:
    """Front matter as the Hugging Face hub reads it."""
    environment = card.environment
    height, width = environment.frame_size
    total = sum(card.splits.values())
    engine = [] if card.source else ["simulation", environment.engine.lower().replace(" ", "-")]
    return {
        "pretty_name": f"{environment.name}, {height}×{width}",
        "license": "unknown",
        "task_categories": ["robotics", "image-to-video"],
        "tags": ["world-model", "action-conditioned", "video", *engine, "webdataset", "acwm"],
        "size_categories": [next((name for top, name in SIZES if total < top), "n>1M")],
        "configs": [
            {
                "config_name": "default",
                "data_files": [{"split": s, "path": f"{s}/*.tar"} for s in card.splits],
            }
        ],
    }


def _introduction(card: DatasetCard) -> str:
    environment = card.environment
    height, width = environment.frame_size
    origin = "Recorded" if card.source else f"Simulated with {environment.engine}"
    notes = "".join(f"\n- {note}" for note in card.source.get("notes", ()))
    summary = f"{environment.summary}\n\n" if environment.summary else ""
    return (
        f"{summary}{origin}: videos of {height}×{width} pixels at "
        f"{environment.fps} frames per second, of up to {environment.horizon} frames, with the "
        f"action of every frame, for action-conditioned video world models. {card.padding}"
        + (f"\n{notes}" if notes else "")
    )


def _splits(card: DatasetCard, manifests: Manifests) -> str:
    rows: list[Sequence[object]] = []
    for split, manifest in manifests.items():
        records = manifest.ordered()
        frames, size = sum(r.frames for r in records), sum(r.size for r in records)
        episodes = sum(r.episodes for r in records)
        rows.append((f"`{split}`", episodes, frames, len(records), f"{size:,}"))
    sums = "".join(f"\n    {digest}  {split}" for split, digest in card.checksums.items())
    return (
        "## Splits\n\n"
        + _table(("Split", "Episodes", "Frames", "Shards", "Bytes"), rows)
        + "\n\nA split's `manifest.jsonl` holds the SHA-256 of each of its shards. The SHA-256 of "
        "these, one per line without a line break at the end, is\n" + sums
    )


def _actions(card: DatasetCard) -> str:
    action = card.environment.action
    found = card.actions.get("train") or next(iter(card.actions.values()), None)
    rows: list[Sequence[object]] = []
    for index, name in enumerate(action.names):
        row = [f"`{name}`", action.units[index] or "–", action.low[index], action.high[index]]
        if found:
            row += [f"{found['mean'][index]:.4g}", f"{found['std'][index]:.4g}"]
        rows.append(row)
    heads = ("Action", "Unit", "Low", "High", *(("Mean", "Std") if found else ()))
    return f"## Actions\n\nOf kind *{action.kind}*.\n\n{_table(heads, rows)}"


def _factors(card: DatasetCard) -> str:
    environment = card.environment
    if not environment.factors:
        return ""
    shifts = ", ".join(f"`{name}`" for name in environment.ood_shifts)
    set_here = ", ".join(f"`{name}={value}`" for name, value in card.factors.items())
    return (
        "## Factors of variation\n\n"
        "`train` and `ind_test` draw active factors from their training values and leave the "
        "others nominal; "
        + (f"`ood_test` shifts one per episode in turn, of {shifts}." if shifts else "none shifts.")
        + (f" In this dataset {set_here}." if set_here else "")
        + "\n\n"
        + _table(
            ("Factor", "What it is", "Nominal", "Training", "Out of distribution", "Active"),
            [_factor(factor) for factor in environment.factors],
        )
    )


def _factor(factor: Factor) -> Sequence[object]:
    unit = f" {factor.unit}" if factor.unit else ""
    if factor.kind == "discrete":
        train, ood = (", ".join(map(str, values)) for values in (factor.train, factor.ood))
    else:
        train = "{} – {}".format(*factor.train) + unit
        ood = ", ".join("{} – {}".format(*interval) for interval in factor.ood) + unit
    active = "yes" if factor.active else "no"
    what = (f"`{factor.name}`", factor.description)
    return (*what, f"{factor.nominal}{unit}", train, ood, active)


def _state(environment: EnvironmentCard) -> str:
    if not environment.state:
        return ""
    rows = [
        (f"`{field.name}`", list(field.shape), field.unit or "–", field.description)
        for field in environment.state
    ]
    table = _table(("Field", "Shape per frame", "Unit", "What it is"), rows)
    return f"## Ground truth\n\n{table}"


def _format(environment: EnvironmentCard) -> str:
    ids = ", ".join(f"{index} {name}" for index, name in enumerate(environment.instances))
    return (
        "## Format\n\nWebDataset tars of whole episodes; `train-000012` is episode 12 of "
        "`train`.\n\n"
        + _table(("Member", "Content"), [(f"`{name}`", content) for name, content in MEMBERS])
        + (f"\n\nInstance ids: {ids}." if ids else "")
    )


def _loading(card: DatasetCard) -> str:
    split = next(iter(card.splits))
    return f"""## Loading

With acwm, in random access (`pip install acwm`):

```python
from acwm_core.data.episodes import EpisodeDataset

episodes = EpisodeDataset("PATH OR URL OF THIS FOLDER", "{split}")
episode = episodes[0]
episode.video, episode.actions, episode.states, episode.masks, episode.contacts
```

With WebDataset and PyAV alone, in sequence:

```python
import glob, io
import av, numpy, webdataset

for sample in webdataset.WebDataset(sorted(glob.glob("{split}/*.tar")), shardshuffle=False):
    actions = numpy.load(io.BytesIO(sample["actions.npy"]))
    with av.open(io.BytesIO(sample["video.mkv"])) as film:
        video = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
```"""


def _making(card: DatasetCard) -> str:
    versions = "".join(f"\n- {name} {version}" for name, version in card.versions.items())
    return (
        f"## How it was made\n\n    {card.command('FOLDER')}\n\nwith\n{versions}\n\n"
        "`acwm data check FOLDER` verifies it.\n\n"
        "No licence is stated yet: whoever publishes the data states one, above as well."
    )


def _citation(environment: EnvironmentCard) -> str:
    return f"## Citation\n\n{environment.citation}" if environment.citation else ""


def _table(heads: Sequence[str], rows: Rows) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    cells = ([str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)
