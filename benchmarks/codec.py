"""Reconstruction PSNR of a codec in every environment, at 64×64 and at the environment's own size.

    python benchmarks/codec.py                             # the table in docs/findings/codecs.md
    python benchmarks/codec.py compact weights=mine.safetensors
    python benchmarks/codec.py identity --only push_cube --only reacher

The episodes have a seed that no training used. They are generated into ``--data`` once and reused
afterwards. One clip of 37 frames is used from every episode: the beginning of the first episode,
the end of the last, and positions in between from the others. PSNR is computed from the mean
squared error pooled over the clips of a split.
"""

import math
from pathlib import Path

import click
import numpy as np
import torch
from codec_pictures import picture
from PIL import Image
from torch import Tensor

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.episode import Split
from acwm_core.model.codec import Codec
from acwm_core.plugins import catalog

ENVIRONMENTS = (
    "push_cube",
    "stack_cube",
    "push_rope",
    "cloth_move",
    "push_sand",
    "pour_water",
    "robot_arm",
    "reacher",
)
SIZES: dict[str, int | None] = {"64": 64, "full": None}
SPLITS: tuple[Split, ...] = ("ind_test", "ood_test")
FRAMES = 37
SEED = 12345


def test_data(root: Path, environment: str, size: str, episodes: int) -> Path:
    """The folder with the test episodes of an environment; generated if it is incomplete."""
    folder = root / f"{environment}_{size}"
    counts: dict[Split, int] = {split: episodes for split in SPLITS}
    generate(environment, folder, episodes=counts, seed=SEED, size=SIZES[size])
    return folder


def clips(folder: Path, split: Split) -> list[Tensor]:
    """One clip ``[1, 37, 3, H, W]`` uint8 per episode, starting later from episode to episode."""
    episodes = EpisodeDataset(folder, split)
    places = np.linspace(0, 1, len(episodes))
    found: list[Tensor] = []
    for index, place in enumerate(places):
        start = round(place * max(0, episodes.lengths[index] - FRAMES))
        found.append(torch.from_numpy(episodes.video(index, start, start + FRAMES))[None])
    return found


@torch.inference_mode()
def squared_error(codec: Codec, clip: Tensor) -> float:
    """Mean squared error of the reconstruction of a uint8 clip, on [0, 1]."""
    video = clip.float() / 255
    return (codec(video) - video).square().mean().item()


def decibels(error: float) -> float:
    """PSNR of a mean squared error of values in [0, 1]; infinite if the error is zero."""
    return -10 * math.log10(error) if error else math.inf


def cells(codec: Codec, folder: Path, drawing: Path | None) -> tuple[str, list[str]]:
    """Frame size and a table cell per split for one environment; also draws `drawing` if given."""
    row: list[str] = []
    for split in SPLITS:
        found = clips(folder, split)
        errors = [squared_error(codec, clip) for clip in found]
        row.append(f"{decibels(sum(errors) / len(errors)):.2f}")
    height, width = found[0].shape[-2:]
    if drawing:
        draw(codec, found[len(found) // 2], drawing)
    return f"{height}×{width}", row


@torch.inference_mode()
def draw(codec: Codec, clip: Tensor, path: Path) -> None:
    """Write frames of the clip, its reconstruction and their difference as a PNG."""
    video = clip.float() / 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(video[0], codec(video)[0])).save(path)


@click.command()
@click.argument("name", default="compact")
@click.argument("options", nargs=-1)
@click.option("--only", multiple=True, help="An environment; all eight by default.")
@click.option("--size", "sizes", multiple=True, type=click.Choice([*SIZES]), default=[*SIZES])
@click.option(
    "--episodes",
    type=(int, int),
    default=(24, 8),
    show_default=True,
    help="Per split at 64×64, and at the full size.",
)
@click.option("--data", type=click.Path(path_type=Path), default=Path("data/codec_test"))
@click.option("--pictures", type=click.Path(path_type=Path), help="Folder for pictures of clips.")
def main(
    name: str,
    options: tuple[str, ...],
    only: tuple[str, ...],
    sizes: tuple[str, ...],
    episodes: tuple[int, int],
    data: Path,
    pictures: Path | None,
) -> None:
    """Print the table for the codec NAME, made with OPTIONS such as weights=FILE."""
    codec: Codec = catalog().create("codec", name, **dict(o.split("=", 1) for o in options))
    counts = dict(zip(SIZES, episodes, strict=True))
    print(f"{name} {codec.fingerprint()}: PSNR in dB of the reconstruction\n")
    print(
        "| Environment | Size | ind_test | ood_test | Episodes |\n| --- | --- | --- | --- | --- |"
    )
    for size in sizes:
        for environment in only or ENVIRONMENTS:
            folder = test_data(data, environment, size, counts[size])
            drawing = pictures / f"{environment}_{size}.png" if pictures else None
            frame, row = cells(codec, folder, drawing)
            line = " | ".join([environment, frame, *row, str(counts[size])])
            print(f"| {line} |", flush=True)


if __name__ == "__main__":
    main()
