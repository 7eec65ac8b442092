"""The first table of ACWM-Phys: many methods on all worlds, from their videos alone.

    python benchmarks/first_table.py --out runs/first_table                      # all of it, hours
    python benchmarks/first_table.py reacher --methods nearest,simvp             # a part
    python benchmarks/first_table.py --out runs/first_table --table              # what there is

Each method is trained on the same episodes, predicts the tasks that `acwm benchmark export` writes,
and is scored by `acwm score`. The programs stop training after `MINUTES`; the steps of the others
are a guess at as much, so the table tells the CPU-minutes that each took, predicting included. What
is there is not made again, so the command can be stopped and repeated.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import acwm
from acwm_core.model.codec import Codec

WORLDS = (
    "push_cube", "stack_cube", "push_rope", "cloth_move", "push_sand", "pour_water", "robot_arm",
    "reacher",
)  # fmt: skip
SPLITS = ("ind_test", "ood_test")
ENTRIES = Path(__file__).parents[1] / "examples" / "entries"
EPISODES, TESTS, BRANCHED = 160, 16, 2
"""Training episodes; test episodes per split; those of them with other actions."""

MINUTES = 6.0
"""CPU-minutes of training of the programs in `examples/entries`. On a slow core that is too short
for SimVP: on `reacher` it has 16.7 dB then, where the repeated first frame has 23.1."""

BUDGET = ("--minutes", str(MINUTES), "--seed", "{seed}")

SETTINGS = (
    "training.cpu_threads=1", "training.sample_every_n_steps=0", "data.validation_episodes=8",
    "training.validate_every_n_steps=500",
)  # fmt: skip


class Place(NamedTuple):
    """Where the files of a world and a method are."""

    out: Path
    world: str
    method: str = ""
    seed: int = 0

    @property
    def data(self) -> Path:
        """Its training episodes."""
        return self.out / "data" / self.world

    @property
    def tasks(self) -> Path:
        """What a participant gets."""
        return self.out / "tasks" / self.world

    @property
    def truth(self) -> Path:
        """What the organiser keeps."""
        return self.out / "tasks" / f"{self.world}-truth" / self.world

    @property
    def entry(self) -> str:
        """The method, and the seed if it is not 0."""
        return f"{self.method}-{self.seed}" if self.seed else self.method

    @property
    def run(self) -> Path:
        """A run of `acwm fit`."""
        return self.out / "runs" / self.world / self.entry

    @property
    def predictions(self) -> Path:
        """What a participant sends."""
        return self.out / "predictions" / self.world / self.entry

    @property
    def scores(self) -> Path:
        """What `acwm score` writes."""
        return self.out / "scores" / self.entry

    @property
    def summary(self) -> Path:
        """The scores of this world."""
        return self.scores / self.world / "evaluation" / "summary.json"


def program(name: str, *options: str, train: bool = True) -> Callable[[Place], list[list[str]]]:
    """The command of a program in `examples/entries`."""

    def commands(place: Place) -> list[list[str]]:
        data = ["--data", str(place.data)] if train else []
        files = ["--tasks", str(place.tasks), "--out", str(place.predictions)]
        named = [option.format(place.world, seed=place.seed) for option in options]
        return [[sys.executable, str(ENTRIES / f"{name}.py"), *data, *files, *named]]

    return commands


def trained(steps: int, *words: str) -> Callable[[Place], list[list[str]]]:
    """`acwm fit`, and the predictions of the run."""

    def commands(place: Place) -> list[list[str]]:
        limits = [
            f"trainer.max_steps={steps}",
            f"training.seed={place.seed}",
            f"data.path={place.data}",
        ]
        fit = ["fit", place.world, "+small", *words, *limits, *SETTINGS, "--out", str(place.run)]
        predict = program("trained", "--run", str(place.run), "--name", place.method, train=False)
        return [[*ACWM, *fit], *predict(place)]

    return commands


ACWM = [sys.executable, "-m", "acwm_core.cli"]

METHODS: dict[str, tuple[str, Callable[[Place], list[list[str]]]]] = {
    "nearest": ("nearest neighbour", program("nearest")),
    "simvp": ("SimVP (next frame)", program("simvp", *BUDGET)),
    "edm": ("EDM (DIAMOND, half its width)", program("edm_unet", "--channels", "32", *BUDGET)),
    "dit": ("diffusion forcing, `dit_xs`", trained(1100)),
    "next_frame": ("denoised next frame", trained(1100, "+next_frame")),
    "grid": ("grid, `+recurrent`", trained(1000, "+recurrent")),
    "points": (
        "scene, learnt points",
        trained(150, "+points", "objective.point_steps=500", "objective.motion_steps=2000"),
    ),
    "scene": ("scene, declared states", trained(400, "+scene", "objective.motion_steps=3000")),
    "shipped": ("the model that ships", program("trained", "--run", "{}", train=False)),
    "codec": ("its codec alone", lambda place: []),
}  # fmt: skip


@click.command()
@click.argument("worlds", nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/first_table"))
@click.option("--methods", default=",".join(METHODS), help="Names, separated by commas.")
@click.option("--seed", default=0, help="Of training.")
@click.option("--table", is_flag=True, help="Only print the table of the scores that there are.")
def main(worlds: tuple[str, ...], out: Path, methods: str, seed: int, table: bool) -> None:
    """Make the table, and print it."""
    chosen = [name.strip() for name in methods.split(",")]
    for method in [] if table else chosen:
        for world in worlds or WORLDS:
            enter(Place(out.absolute(), world, method, seed))
    for world in worlds or WORLDS:
        print_table(out.absolute(), world)


def enter(place: Place) -> None:
    """Predict the tasks by a method and score them, unless that is done."""
    if place.summary.exists():
        return
    prepare(place)
    costs = place.out / "costs" / f"{place.world}-{place.entry}.json"
    if not costs.exists():
        seconds = [run(command) for command in METHODS[place.method][1](place)]
        if place.method == "codec":
            encode_truth(place)
        costs.parent.mkdir(exist_ok=True)
        costs.write_text(json.dumps(seconds))
    tasks = ["--tasks", str(place.tasks), "--out", str(place.scores), "--workers", "0"]
    run([*ACWM, "score", str(place.predictions), *tasks])


def prepare(place: Place) -> None:
    """The training episodes and the tasks of a world."""
    if not place.data.exists():
        episodes = ["--episodes", f"{EPISODES},2,2", "--workers", "1", "--out", str(place.data)]
        run([*ACWM, "generate", place.world, "--size", "64", *episodes])
    if not place.tasks.exists():
        sizes = ["--size", "64", "--episodes", str(TESTS), "--workers", "1"]
        branched = f"evaluation.counterfactual_episodes={BRANCHED}"
        out = ["--out", str(place.tasks), branched]
        run([*ACWM, "benchmark", "export", place.world, *sizes, *out])


def run(command: list[str]) -> float:
    """Run a command to its end; the CPU-seconds that it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def encode_truth(place: Place) -> None:
    """Write true videos through the codec of the model that ships; branches stand still."""
    codec = acwm.load(place.world).world_model.codec
    for line in (place.tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        first = np.asarray(Image.open(place.tasks / task["images"][0], formats=["PNG"]))
        frames = np.repeat(first[None], task["frames"], 0)
        if not task["branch"]:
            split, number = task["id"].split("/")[1].rsplit("-", 1)
            frames = coded(codec, acwm.EpisodeDataset(place.truth, split)[int(number)].video)
        folder = place.predictions / task["id"]
        folder.mkdir(parents=True, exist_ok=True)
        for moment, frame in enumerate(frames):
            Image.fromarray(frame).save(folder / f"{moment:04d}.png")
    (place.predictions / "entry.yaml").write_text("name: codec\nparameters: 0\ndata: none\n")


@torch.no_grad()
def coded(codec: Codec, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames `[T, H, W, 3]` encoded and decoded."""
    video = torch.from_numpy(frames).permute(0, 3, 1, 2)[None] / 255
    decoded = codec.decode(codec.encode(video), len(frames))[0].clamp(0, 1)
    return (255 * decoded.permute(0, 2, 3, 1)).round().byte().numpy()


def print_table(out: Path, world: str) -> None:
    """The rows of a world; pairs are in and out of distribution."""
    print(f"\n{world}\n\n| Method | " + " | ".join((*COLUMNS, COST)) + " |")
    print("|" + " --- |" * (len(COLUMNS) + 2))
    shown = False
    for method, (title, _) in METHODS.items():
        place = Place(out, world, method)
        if not place.summary.exists():
            continue
        splits = json.loads(place.summary.read_text())["splits"]
        if not shown:
            print(table_row("first frame", splits, "copy", ""))
            print(table_row("simulator, a millimetre off", splits, "perturbed", ""))
            shown = True
        costs = json.loads((out / "costs" / f"{world}-{method}.json").read_text())
        minutes = "–" if method in ("shipped", "codec") else f"{sum(costs) / 60:.1f}"
        print(table_row(title, splits, "model", minutes, branches=method != "codec"))


COST = "CPU-minutes, with predicting"
COLUMNS = ("PSNR, dB", "response", "position, mm", "permanence", "sharpness")
METRICS = {"psnr": (1, 1), "position_error": (1000, 0), "permanence": (1, 2), "sharpness": (1, 2)}
"""Factor and digits of each metric."""


def table_row(
    title: str, splits: dict[str, Any], row: str, minutes: str, branches: bool = True
) -> str:
    """A row of the table in Markdown."""

    def pair(values: list[float | None], factor: float, digits: int) -> str:
        texts = ["–" if v is None else f"{factor * v:.{digits}f}" for v in values]
        return texts[0] if texts == ["–", "–"] else ", ".join(texts)

    def response(split: dict[str, Any]) -> float | None:
        rows = (split.get("counterfactual") or {}).get("rows", {})
        return rows[row]["response"]["value"] if branches and row in rows else None

    cells = {}
    for name, (factor, digits) in METRICS.items():
        scores = [splits[split]["scores"]["rows"][row].get(name) for split in SPLITS]
        cells[name] = pair([score and score["value"] for score in scores], factor, digits)
    answers = pair([response(splits[split]) for split in SPLITS], 1, 2)
    columns = [cells["psnr"], answers, *list(cells.values())[1:]]
    return f"| {title} | " + " | ".join(columns) + f" | {minutes} |"


if __name__ == "__main__":
    main()
