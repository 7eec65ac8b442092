"""The table of docs/findings/trained-models.md: scores of the models that ship; and a picture.

    python benchmarks/zoo.py
    python benchmarks/zoo.py --picture docs/zoo.jpg      # simulates some minutes

The table is read from the evaluations that ship with the models. The picture shows one test episode
per environment, truth above and prediction below: of the first episodes, simulated as the model's
card says, the one whose frames change most.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import torch
from PIL import Image

from acwm_core.data.card import DatasetCard
from acwm_core.data.pictures import Picture, join, moments, to_pixels
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.evaluation.results import SetSummary, Summary
from acwm_core.evaluation.shares import error_shares
from acwm_core.training.run import load_run, read_metadata
from acwm_core.training.run_folder import RunFolder
from acwm_formats.sheets import GAP, magnified
from acwm_zoo.shipped import folder, shipped

SPLITS = ("ind_test", "ood_test")
COLUMNS = ("world", "trained on", "steps, CPU-hours", "PSNR, dB", "codec, dB", "other start, dB")
COLUMNS += ("codec, world, model, %", "response", "position or height error, mm", "permanence")
MOMENTS = 6
"""Number of square frames in a row; fewer if frames are wide."""

LOOKED_AT = 16
"""Number of test episodes from which the shown one is chosen."""


@click.command()
@click.option("--picture", type=click.Path(path_type=Path), help="Image file to write.")
def main(picture: Path | None) -> None:
    """Print the table, and draw the picture if requested."""
    print("| " + " | ".join(COLUMNS) + " |\n|" + " --- |" * len(COLUMNS))
    for name in shipped():
        print("| " + " | ".join(row(name)) + " |")
    if picture:
        worlds = [name for name in shipped() if name == world_of(name)]  # no second one of a world
        rows = [strip(name) for name in worlds]
        half = -(-len(rows) // 2)
        columns = [join(column, down=True, gap=12) for column in (rows[:half], rows[half:])]
        Image.fromarray(join(columns, gap=GAP)).save(picture, quality=88)


def world_of(name: str) -> str:
    """The environment that a model was trained on."""
    return DatasetCard.read(RunFolder(folder(name)).card).environment.name


def row(name: str) -> list[str]:
    """The table cells of a model; two splits as in distribution / out of distribution."""
    run, summary = RunFolder(folder(name)), Summary.read(folder(name))
    facts, card = read_metadata(run.weights), DatasetCard.read(run.card)
    before = facts.get("init_from", {"step": 0, "cpu_seconds": 0})
    seconds = facts["cpu_seconds"] + before["cpu_seconds"]
    explored = f", {card.exploration:.0%} exploratory" if card.exploration else ""

    def scores(metric: str, of: str = "model", scale: float = 1, digits: int = 1) -> str:
        found = [summary.splits[split].scores.rows[of].get(metric) for split in SPLITS]
        values = [each.value for each in found if each and each.value is not None]
        return " / ".join(f"{scale * value:.{digits}f}" for value in values)

    answers = [summary.splits[split].counterfactual for split in SPLITS]
    response = [each.rows["model"]["response"].value for each in answers if each]
    return [
        name,
        f"{card.splits['train']:,} episodes{explored}",
        f"{facts['step'] + before['step']:,}, {seconds / 3600:.1f}",
        scores("psnr"),
        scores("psnr", "codec"),
        scores("psnr", "perturbed"),
        " / ".join(shares(summary.splits[split].scores) for split in SPLITS),
        " / ".join(f"{value:.2f}" for value in response if value is not None),
        scores("position_error", scale=1e3) or scores("height_error", scale=1e3),
        scores("permanence", digits=2),
    ]


def shares(scores: SetSummary) -> str:
    """The shares of the squared error of codec, world and model, in percent."""
    found = error_shares(scores)
    parts = (found.codec, found.world or 0, found.model) if found else ()
    return ", ".join(f"{100 * part:.0f}" for part in parts)


def strip(name: str) -> Picture:
    """Frames of a test episode in a row, and of its prediction below."""
    bundle = load_run(folder(name))
    card = DatasetCard.read(RunFolder(folder(name)).card)
    environment = make_environment(card.environment.name, card.options)
    episodes = [simulate(environment, card.spec("ind_test", i)) for i in range(LOOKED_AT)]
    environment.close()
    shown = max(episodes, key=lambda each: np.abs(np.diff(each.video.astype(float), axis=0)).mean())
    truth = shown.video
    first = torch.from_numpy(truth[:1]).permute(0, 3, 1, 2).float() / 255
    actions = torch.from_numpy(shown.actions)[None]
    predicted = bundle.world_model.rollout(first, actions, check=False)[0]
    height, width = truth.shape[1:3]
    chosen = moments(len(truth), MOMENTS * height // width)
    videos = truth, to_pixels(predicted)
    rows = [join([magnified(video[t]) for t in chosen], gap=GAP) for video in videos]
    return join(rows, down=True, gap=2)


if __name__ == "__main__":
    main()
