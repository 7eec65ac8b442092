"""Write recordings.webp of docs/your-own-data.md: `python docs/record_recordings.py RUN RUN RUN`.

The runs learnt from more and more recordings of an arm whose states nobody recorded:

    acwm generate reacher --episodes 1040,32,0 --size 64x64 --seed 72 --exploration 0.4 --out arm
    acwm fit reacher +small +points data.path=arm data.validation_episodes=16 SHARE STEPS

with a SHARE of `data.fraction` 1, 0.15 and 0.034, and STEPS for points, motion and pictures
(`objective.point_steps`, `objective.motion_steps`, `trainer.max_steps`) of 1000, 3000, 400; of 600,
1500, 200; and of 400, 1000, 120.

Each predicts whole test episodes from their first frame and the actions. Prints their PSNR, too.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acwm_core.data.clips import hold_out, take_fraction
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.recipe import Recipe
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder

OUT = Path(__file__).resolve().parent / "recordings.webp"
SHOWN, FRAMES, SIDE, QUALITY = (0, 1), 9, 88, 75  # episodes; frames of each; pixels; of the file
LEFT, STRIP, GAP, INK = 118, 22, 10, "#1b1d22"
FONT = ImageFont.load_default(size=13)

Video = NDArray[np.uint8]  # [T, H, W, 3]


def main(runs: Sequence[str]) -> None:
    """Predict by each run, print how well, compose and write."""
    data = Recipe.from_yaml(RunFolder(Path(runs[0])).recipe).data["path"]
    tests = EpisodeDataset(data, "ind_test")
    rows: list[tuple[str, list[Video]]] = [("what was filmed", [tests[n].video for n in SHOWN])]
    first = [np.repeat(each.video[:1], len(each.video), 0) for each in tests]
    print(f"first frame: {scores(tests, first)}")
    for run in runs:
        predicted = [*predictions(Path(run), tests)]
        print(f"{recordings(Path(run))} recordings: {scores(tests, predicted)}")
        rows.append((f"{recordings(Path(run))} recordings", [predicted[n] for n in SHOWN]))
    composed(rows).save(OUT, quality=QUALITY, method=6)
    print(f"{OUT.name}: {OUT.stat().st_size / 1e3:.0f} kB")


def recordings(run: Path) -> int:
    """How many episodes a run learnt from."""
    data = Recipe.from_yaml(RunFolder(run).recipe).data
    training, _ = hold_out(len(EpisodeDataset(data["path"], "train")), data["validation_episodes"])
    return len(take_fraction(training, data["fraction"]))


@torch.no_grad()
def predictions(run: Path, tests: EpisodeDataset) -> Sequence[Video]:
    """Whole episodes from their first frames and their actions."""
    model, videos = load_run(run).world_model, list[Video]()
    for episode in tests:
        first = torch.from_numpy(episode.video[:1]).permute(0, 3, 1, 2).float() / 255
        video = model.rollout(first, torch.from_numpy(episode.actions)[None], check=False)[0]
        videos.append((255 * video.permute(0, 2, 3, 1)).round().byte().numpy())
    return videos


def scores(tests: EpisodeDataset, videos: Sequence[Video]) -> str:
    """Mean PSNR of the frames after the first one: of all, and by thirds of the episodes."""
    rows = list[list[float]]()
    for episode, video in zip(tests, videos, strict=True):
        error = (episode.video[1:] / 255 - video[1:] / 255) ** 2
        psnr = -10 * np.log10(np.maximum(error.mean((1, 2, 3)), 1e-8))
        rows.append([psnr.mean(), *(part.mean() for part in np.array_split(psnr, 3))])
    whole, *thirds = np.mean(rows, 0)
    return f"{whole:.1f} dB ({', '.join(f'{each:.1f}' for each in thirds)})"


def composed(rows: Sequence[tuple[str, Sequence[Video]]]) -> Image.Image:
    """Frames of episodes, one row for the truth and for each run."""
    height = len(SHOWN) * (len(rows) * SIDE + GAP) + STRIP
    picture = Image.new("RGB", (LEFT + FRAMES * SIDE, height), "white")
    pen = ImageDraw.Draw(picture)
    times = np.linspace(0, len(rows[0][1][0]) - 1, FRAMES).astype(int)
    for column, time in enumerate(times):
        pen.text((LEFT + column * SIDE + 4, 3), f"frame {time}", fill=INK, font=FONT)
    for number in range(len(SHOWN)):
        for row, (name, videos) in enumerate(rows):
            top = STRIP + number * (len(rows) * SIDE + GAP) + row * SIDE
            pen.text((4, top + SIDE // 2 - 8), name, fill=INK, font=FONT)
            for column, time in enumerate(times):
                frame = Image.fromarray(videos[number][time]).resize((SIDE, SIDE))
                picture.paste(frame, (LEFT + column * SIDE, top))
    return picture


if __name__ == "__main__":
    main(sys.argv[1:])
