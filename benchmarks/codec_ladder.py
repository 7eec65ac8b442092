"""Codecs of several sizes, each trained from the start in the same CPU time: rate and distortion.

    OMP_NUM_THREADS=1 python benchmarks/codec_ladder.py --figure docs/codec_ladder.svg

A rung is a codec like `compact` (cells of 8×8 pixels) or `fine` (4×4) with another number of latent
channels. First it measures how long a step of each takes, which needs an idle machine; these set
the numbers of steps. Then all are trained as `acwm train-codec` does, on the same episodes at
64×64, and reconstruct test episodes of the same worlds. It prints the table of
docs/findings/codecs.md, and is continued by the same command when it was interrupted.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import NamedTuple

import click
import matplotlib.pyplot as plt
import torch

from acwm_codecs.compact import Compact, Fine
from acwm_codecs.frame_groups import Source, load_videos
from acwm_codecs.train_codec import Training, reconstruction
from acwm_core.data.generate import generate

WORLDS = ("push_cube", "push_rope", "robot_arm")
EPISODES = {"train": 160, "ind_test": 12}
SEED = 54321
BATCH, PEAK, DECAY = 16, 8e-4, 0.5
PACED = 20
"""Steps of each rung whose time is measured."""


class Rung(NamedTuple):
    """A codec of the ladder.

    Attributes:
        like: the codec that it is like but for its channels.
        channels: its latent channels.
        seed: of its first weights.
    """

    like: type[Compact]
    channels: int
    seed: int = 0

    @property
    def name(self) -> str:
        """Sides of a cell in pixels, and channels."""
        return f"{self.like.spatial_stride}×{self.like.spatial_stride}, {self.channels}"

    @property
    def rate(self) -> float:
        """Numbers per frame of 64×64."""
        return self.channels * (64 / self.like.spatial_stride) ** 2 / self.like.temporal_stride

    def make(self) -> Compact:
        """The untrained codec."""
        torch.manual_seed(self.seed)
        kind = type(f"Rung{self.channels}", (self.like,), {"channels": self.channels})
        return kind(weights="random")


RUNGS = (
    *(Rung(Compact, channels) for channels in (4, 8)),
    Rung(Compact, 16, seed=1),  # with 0 it ended at 11 dB
    Rung(Compact, 32),
    *(Rung(Fine, channels) for channels in (4, 8, 16)),
)


def pace(rung: Rung, sources: list[Source]) -> float:
    """CPU-seconds of a step."""
    training = Training(rung.make().train(), sources, batch=BATCH, seed=0)
    began = time.process_time()
    for _ in training.steps(PACED, PEAK, 0.0):
        pass
    return (time.process_time() - began) / PACED


def climb(
    rung: Rung, sources: list[Source], folders: dict[str, Path], steps: int
) -> dict[str, float]:
    """Train a codec: its PSNR in dB of each world."""
    codec = rung.make().train()
    for _ in Training(codec, sources, batch=BATCH, seed=0).steps(steps, PEAK, DECAY):
        pass
    decibels = {world: reconstruction(codec.eval(), folder) for world, folder in folders.items()}
    return {world: value for world, value in decibels.items() if value is not None}


@click.command()
@click.option("--data", default=Path("data/ladder"), type=click.Path(path_type=Path))
@click.option("--out", default=Path("runs/ladder.json"), type=click.Path(path_type=Path))
@click.option("--seconds", default=240.0, show_default=True, help="CPU time of each training.")
@click.option("--figure", type=click.Path(path_type=Path), help="Draws the curve.")
def main(data: Path, out: Path, seconds: float, figure: Path | None) -> None:
    """Train all rungs that `--out` does not hold yet; print and draw what they reach."""
    folders = {world: data / world for world in WORLDS}
    for world, folder in folders.items():
        generate(world, folder, episodes=EPISODES, seed=SEED, size=64)
    sources = [Source(load_videos(folder, EPISODES["train"])) for folder in folders.values()]
    if out.exists():
        found = json.loads(out.read_text())
    else:
        found = {rung.name: {"steps": int(seconds / pace(rung, sources))} for rung in RUNGS}
    out.parent.mkdir(parents=True, exist_ok=True)
    for rung in RUNGS:
        out.write_text(json.dumps(found, indent=1))
        if WORLDS[0] not in found[rung.name]:
            found[rung.name] |= climb(rung, sources, folders, found[rung.name]["steps"])
    out.write_text(json.dumps(found, indent=1))
    click.echo(f"| Cell, channels | Numbers per frame | Steps | {' | '.join(WORLDS)} |")
    click.echo("| --- | --- | --- |" + " --- |" * len(WORLDS))
    for rung in RUNGS:
        row = found[rung.name]
        cells = " | ".join(f"{row[world]:.1f}" for world in WORLDS)
        click.echo(f"| {rung.name} | {rung.rate:.0f} | {row['steps']:,} | {cells} |")
    if figure:
        draw(found, figure)


def draw(found: dict[str, dict[str, float]], figure: Path) -> None:
    """Distortion by rate, a chart for each world and a line for each size of a cell."""
    plt.rcParams |= {"svg.hashsalt": "ladder", "svg.fonttype": "none", "font.family": "sans-serif"}
    drawing, charts = plt.subplots(1, len(WORLDS), figsize=(8, 3.3), layout="constrained")
    for world, chart in zip(WORLDS, charts, strict=True):
        for like, colour in ((Compact, "tab:blue"), (Fine, "tab:orange")):
            rungs = [rung for rung in RUNGS if rung.like is like]
            decibels = [found[rung.name][world] for rung in rungs]
            side = like.spatial_stride
            label = f"cells of {side}×{side} pixels"
            chart.plot([rung.rate for rung in rungs], decibels, "o-", color=colour, label=label)
        chart.set(title=world, xscale="log", xlabel="numbers per frame")
        chart.set_xticks([64, 128, 256, 512, 1024], ["64", "128", "256", "512", "1024"])
        chart.minorticks_off()
        chart.spines[["top", "right"]].set_visible(False)
    charts[0].set_ylabel("PSNR, dB")
    lines = charts[0].get_legend_handles_labels()
    drawing.legend(*lines, loc="outside lower center", ncols=2, frameon=False)
    drawing.savefig(figure, metadata={"Date": None})


if __name__ == "__main__":
    main()
