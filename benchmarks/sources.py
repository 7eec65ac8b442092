"""Both small models on recordings of worlds that acwm was not tuned for, and which one is advised.

    python benchmarks/sources.py recordings/fetch recordings/pong --out runs/sources

Each folder is one of `render_sources.py`, or any other of videos with tables of actions. It is
imported, and both models learn from it: points (`+points`) and the grid (`+recurrent`). The table
has the PSNR of whole test episodes from their first frame, and by thirds; the change of PSNR with
the actions of another episode; the energy of the pictures' slopes, relative to the truth; and
CPU-minutes. Strips of frames are written beside the runs. Existing results are not computed again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from first_table import ACWM, SETTINGS, run
from numpy.typing import NDArray
from PIL import Image

import acwm
from acwm_core.training.run import load_run
from acwm_formats.survey.advice import advice_for

MODELS = {
    "grid": ("+recurrent", "trainer.max_steps=500"),
    "points": (
        "+points", "trainer.max_steps=100", "objective.point_steps=300",
        "objective.motion_steps=1500",
    ),
}  # fmt: skip
SHOWN, SIDE = 9, 96
"""Frames in a strip, and their pixels on a side."""

Video = NDArray[np.uint8]  # [T, H, W, 3]


@click.command()
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/sources"))
@click.option("--seed", default=0, help="Of training.")
def main(folders: tuple[Path, ...], out: Path, seed: int) -> None:
    """Train, and print the table."""
    print("| Recordings | Advice | Model | PSNR, dB | other actions | sharpness | CPU-minutes |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for folder in folders:
        data = out / "data" / folder.name
        if not data.exists():
            run([*ACWM, "data", "import", str(folder), "--size", "64", "--out", str(data)])
        advice = advice_for(data)
        assert advice is not None, "imported data is advised on"
        rows = {name: row_of(name, data, out, seed) for name in MODELS}
        first = np.mean(rows["grid"]["first"])
        print(f"| {folder.name} | {advice.why} | first frame | {first:.1f} | | | |")
        for name, row in rows.items():
            advised = " (advised)" if (advice.overlay == "points") == (name == "points") else ""
            print(f"| | | {name}{advised} | {text(row)} |", flush=True)


def row_of(name: str, data: Path, out: Path, seed: int) -> dict[str, Any]:
    """The scores of a model of some data."""
    folder = out / "runs" / data.name / (f"{name}-{seed}" if seed else name)
    result = folder.with_suffix(".json")
    if not result.exists():
        words = [*MODELS[name], f"data.path={data}", f"training.seed={seed}", *SETTINGS]
        seconds = run([*ACWM, "fit", "small", *words, "--out", str(folder)])
        scores = scored(folder, acwm.EpisodeDataset(data, "ind_test"))
        result.write_text(json.dumps({**scores, "minutes": seconds / 60}))
    return json.loads(result.read_text())


@torch.no_grad()
def scored(folder: Path, tests: acwm.EpisodeDataset) -> dict[str, Any]:
    """Scores of whole test episodes, from their first frames."""
    model = load_run(folder).world_model
    episodes = [*tests]
    scores: dict[str, Any] = {"psnr": [], "first": [], "other": [], "sharpness": []}
    for number, episode in enumerate(episodes):
        frames = len(episode.video)
        first = torch.from_numpy(episode.video[:1]).permute(0, 3, 1, 2).float() / 255
        others = episodes[(number + 1) % len(episodes)].actions
        other = np.resize(others, (frames, others.shape[1])).astype(episode.actions.dtype)
        videos = list[Video]()
        for actions in (episode.actions, other):
            video = model.rollout(first, torch.from_numpy(actions)[None], check=False)[0]
            videos.append((255 * video.permute(0, 2, 3, 1)).round().byte().numpy())
        scores["psnr"].append(psnr(episode.video, videos[0]).tolist())
        scores["other"].append(psnr(episode.video, videos[1]).mean())
        scores["first"].append(psnr(episode.video, episode.video[:1].repeat(frames, 0)).mean())
        scores["sharpness"].append(energy(videos[0][1:]) / energy(episode.video[1:]))
        if number < 2:
            strip([episode.video, videos[0]]).save(f"{folder}-{number}.png")
    return scores


def psnr(true: Video, predicted: Video) -> NDArray[np.float64]:
    """Of each frame but the first, in dB."""
    error = ((true[1:] / 255.0 - predicted[1:] / 255.0) ** 2).mean((1, 2, 3))
    return -10 * np.log10(np.maximum(error, 1e-8))


def energy(video: Video) -> float:
    """Mean square of the slopes of frames."""
    pixels = video.astype(float)
    return float(sum((np.diff(pixels, axis=axis) ** 2).mean() for axis in (1, 2)))


def strip(videos: Sequence[Video]) -> Image.Image:
    """Some moments of videos, one row for each."""
    moments = np.linspace(0, len(videos[0]) - 1, SHOWN).astype(int)
    rows = [np.concatenate([video[moment] for moment in moments], 1) for video in videos]
    picture = Image.fromarray(np.concatenate(rows))
    return picture.resize((SHOWN * SIDE, len(videos) * SIDE), Image.Resampling.BICUBIC)


def text(row: dict[str, Any]) -> str:
    """The cells of a row."""
    values = [np.asarray(episode) for episode in row["psnr"]]
    whole = np.mean([value.mean() for value in values])
    thirds = np.mean([[part.mean() for part in np.array_split(v, 3)] for v in values], 0)
    lost = np.mean(row["other"]) - whole
    parts = ", ".join(f"{part:.1f}" for part in thirds)
    cells = [f"{whole:.1f} ({parts})", f"{lost:+.1f}", f"{np.mean(row['sharpness']):.2f}"]
    return " | ".join([*cells, f"{row['minutes']:.1f}"])


if __name__ == "__main__":
    main()
