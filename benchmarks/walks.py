"""How far a reader walks through the code: which files and rooms a call passes through, in order.

    python benchmarks/walks.py fit            from `fit(recipe)` to the first optimiser step
    python benchmarks/walks.py conditioner    from `acwm fit … conditioner=cross_attention` to the
                                              conditioner's constructor
    … --list                                  also prints the files, one stay a line

Functions of this repository count that the main thread calls, and not while a module is imported; a
function counts the first time, as a reader reads it once. Successive functions in one file are one
stay there, and likewise in one room, which is the folder of a package. A return is a stay where one
was before. "N deep" leaves out functions that more than N others of the repository have called, one
by the other: a reader takes them by their names.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
RECIPE = ("base", "codec=compact", "model=dit_xs", "objective=full_sequence", "trainer.max_steps=1")
SMALL = ("data.clip_frames=5", "data.batch_size=2", "data.workers=0", "data.validation_episodes=1")

DEPTHS = (1, 2, 3)


class Arrived(BaseException):
    """Where the walk ends."""


class Walk:
    """Records the files of the functions that are called, until one in `goal` is.

    Attributes:
        files: of functions, in the order of their first calls.
        depths: how many functions of the repository had called each, one by the other.
    """

    def __init__(self, goal: str = "") -> None:
        self.files, self.depths = list[str](), list[int]()
        self._goal, self._known = goal, set[CodeType]()

    def deep(self, most: int) -> list[str]:
        """The files of the functions that are at most so deep."""
        return [f for f, depth in zip(self.files, self.depths, strict=True) if depth <= most]

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """The function for `sys.setprofile`."""
        if event != "call" or frame.f_code in self._known:
            return
        file = _file(frame)
        functions = not file or all(f.f_code.co_flags & CO_OPTIMIZED for f in _inside(frame))
        if functions:  # and no module that is imported
            self._known.add(frame.f_code)
        if file and functions:
            self.files.append(file)
            self.depths.append(sum(map(bool, map(_file, _inside(frame)))) - 1)
            if file == self._goal:
                raise Arrived


def _inside(frame: FrameType | None) -> Iterator[FrameType]:
    """The frame and those that called it, up to this file."""
    while frame is not None and frame.f_code.co_filename != __file__:
        yield frame
        frame = frame.f_back


def _file(frame: FrameType) -> str:
    """The path of a frame's file in the repository; empty for other files, and for this one."""
    name = frame.f_code.co_filename
    own = name.startswith(f"{ROOT}/") and name != __file__ and "/.venv/" not in name
    return str(Path(name).relative_to(ROOT)) if own else ""


def stays(places: Sequence[str]) -> list[str]:
    """The places one after the other, each once for as long as one stays there."""
    return [place for i, place in enumerate(places) if i == 0 or place != places[i - 1]]


def make_dataset(folder: Path) -> None:
    """Make a dataset of a disc that moves by its actions."""
    from acwm_core.data.generate import generate
    from acwm_core.plugins import catalog

    catalog().registry("environment").add("disc", "acwm_core.checks.disc:Disc")
    generate("disc", folder, episodes={"train": 3}, size=64, workers=0, progress=False)


def dataset(folder: Path) -> Path:
    """A dataset that another process makes, so that this one has loaded nothing yet."""
    subprocess.run([sys.executable, __file__, "dataset", f"--out={folder}"], check=True)
    return folder


def walk_of_fit(folder: Path) -> Walk:
    """From `fit(recipe)` to the first optimiser step."""
    from torch.optim.optimizer import register_optimizer_step_pre_hook

    from acwm_core.recipe import compose
    from acwm_core.training.fit import fit

    recipe = compose(RECIPE[0], [*RECIPE[1:], *SMALL, f"data.path={dataset(folder / 'data')}"])

    def arrive(*_: Any) -> None:
        raise Arrived

    walk = Walk()
    register_optimizer_step_pre_hook(arrive)
    sys.setprofile(walk)
    try:
        fit(recipe, folder / "run")
    except Arrived:
        sys.setprofile(None)
    return walk


def walk_of_conditioner(folder: Path) -> Walk:
    """From the command line to the constructor of the conditioner that it names."""
    words = [*RECIPE, *SMALL, f"data.path={dataset(folder / 'data')}"]
    sys.argv = ["acwm", "fit", *words, "conditioner=cross_attention", f"--out={folder / 'run'}"]
    walk = Walk("plugins/acwm_dit/cross_attention.py")
    from acwm_core.cli.main import main

    sys.setprofile(walk)
    try:
        main()
    except Arrived:
        sys.setprofile(None)
    return walk


def main() -> None:
    """Print how many stays and returns a walk has."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("walk", choices=("fit", "conditioner", "dataset"))
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.walk == "dataset":
        return make_dataset(given.out)
    with tempfile.TemporaryDirectory() as folder:
        walk = {"fit": walk_of_fit, "conditioner": walk_of_conditioner}[given.walk](Path(folder))
    for depth in (*DEPTHS, max(walk.depths)):
        files = walk.deep(depth)
        for name, places in (("files", files), ("rooms", [str(Path(f).parent) for f in files])):
            passed = stays(places)
            different = len(set(passed))
            returns = len(passed) - different
            print(f"{depth} deep: {len(passed)} stays in {different} {name}, {returns} returns")
        if given.list:
            print(*(f"    {file}" for file in stays(files)), sep="\n")


if __name__ == "__main__":
    main()
