"""Draw the pictures of reference/environments.md: `docs/build_environments.py [ENVIRONMENT ...]`.

Simulates the named environments, or by default all that ship with acwm.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from environments_text import cards, families
from PIL import Image

from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import Environment
from acwm_core.env.episode import EpisodeSpec, Factor, FactorSetting, Split
from acwm_core.errors import AcwmError
from acwm_formats.sheets import GAP, Label, Picture, contact_sheet, play_together

DOCS = Path(__file__).resolve().parent
PICTURES = DOCS / "environments"
LARGEST = 3 * 2**20
"""Largest size of all pictures together in bytes."""

MOMENTS: dict[str, tuple[Split, int, float]] = {
    "push_cube": ("ind_test", 2, 0.45),
    "cloth_move": ("ind_test", 1, 0.45),
    "push_sand": ("ind_test", 1, 0.6),
    "robot_arm": ("ind_test", 2, 0.75),
}
"""Split, episode and moment (share of its frames) that show a world best; others use `MOMENT`."""

MOMENT: tuple[Split, int, float] = ("ind_test", 0, 0.6)
CELL, ACROSS, QUALITY = 160, 990, 88  # height of a frame, width of a sheet (pixels), of JPEG


def record(
    env: Environment, split: Split, index: int, frames: int, **factors: FactorSetting
) -> tuple[dict[str, Any], Picture]:
    """The info and the first frames of an episode with the behaviour policy."""
    spec = EpisodeSpec(env.card.name, split, index, factors=factors)
    frame, info = env.reset(options={"spec": spec})
    policy, seen = env.policy(spec.rng("policy")), [frame]
    while len(seen) < frames:
        seen.append(env.step(np.asarray(policy(), np.float32))[0])
    return info, np.stack(seen)


def draw(name: str, variant: bool) -> None:
    """Draw all pictures of one environment."""
    env = make_environment(name)
    if variant:
        _save(_sheet(env, [("ind_test", 0), ("ood_test", 0)]), name)
        return
    shifts = max(2, min(3, len(env.card.ood_shifts)))
    _save(_sheet(env, [("ind_test", k) for k in range(2)]), f"{name}_ind")
    _save(_sheet(env, [("ood_test", k) for k in range(shifts)]), f"{name}_ood")
    inactive = [factor for factor in env.card.factors if not factor.active]
    if inactive:
        _save(_factor_sheet(env, inactive), f"{name}_factors")


def draw_worlds(names: list[str]) -> None:
    """Draw one moment of each environment, in a picture for the top of the page."""
    moments = []
    for name in names:
        env = make_environment(name)
        split, index, share = MOMENTS.get(name, MOMENT)
        frame = record(env, split, index, 1 + round(share * (env.card.horizon - 1)))[1][-1]
        side = min(frame.shape[:2])
        left = (frame.shape[1] - side) // 2
        moments.append(_resized(frame[:side, left : left + side], 240)[None])
    (picture,) = play_together([Label(name) for name in names], moments, across=4)
    _save(picture, "worlds")


def _sheet(env: Environment, episodes: list[tuple[Split, int]]) -> Picture:
    labels, videos = [], []
    for split, index in episodes:
        info, frames = record(env, split, index, env.card.horizon)
        labels.append(Label(f"{split} {index}", info["ood_label"] or ""))
        videos.append(frames)
    columns, height = _layout(env)
    kept = np.linspace(0, env.card.horizon - 1, columns).round().astype(int)
    small = [np.stack([_resized(frames[t], height) for t in kept]) for frames in videos]
    return contact_sheet(labels, small, columns)


def _factor_sheet(env: Environment, factors: list[Factor]) -> Picture:
    """The same moment with usual factors, and with each factor out of distribution."""
    split, index, share = MOMENT
    frames = 1 + round(share * (env.card.horizon - 1))
    labels, moments = [Label("as usual")], [record(env, split, index, frames)[1][-1]]
    for factor in factors:
        info, seen = record(env, split, index, frames, **{factor.name: "ood"})
        value = info["factors"][factor.name]
        text = value if isinstance(value, str) else f"{value:.2g}"
        labels.append(Label(factor.name, text))
        moments.append(seen[-1])
    columns, height = _layout(env)
    small = [_resized(frame, height)[None] for frame in moments]
    rows = math.ceil(len(small) / columns)
    (picture,) = play_together(labels, small, across=math.ceil(len(small) / rows))
    return picture


def _layout(env: Environment) -> tuple[int, int]:
    """Frames in a row of a sheet, and their height in pixels."""
    height, width = env.frame_size
    columns = max(4, ACROSS // round(CELL * width / height))
    return columns, min(CELL, (ACROSS // columns - GAP) * height // width)


def _resized(frame: Picture, height: int) -> Picture:
    width = round(height * frame.shape[1] / frame.shape[0])
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS))


def _save(picture: Picture, name: str) -> None:
    path = PICTURES / f"{name}.jpg"
    Image.fromarray(picture).save(path, quality=QUALITY, subsampling=0, optimize=True)
    print(f"{path.relative_to(DOCS.parent)}  {path.stat().st_size / 1024:.0f} KB", flush=True)


def main() -> None:
    """Draw the requested pictures."""
    parser = argparse.ArgumentParser(
        description="Draw the pictures of docs/reference/environments.md."
    )
    parser.add_argument("environments", nargs="*", help="whose pictures; by default all")
    chosen = parser.parse_args()
    found = cards()
    PICTURES.mkdir(exist_ok=True)
    tree = families(found)
    for name in chosen.environments or found:
        draw(name, variant=name not in tree)
    draw_worlds(list(tree))
    size = sum(path.stat().st_size for path in PICTURES.glob("*.jpg"))
    if size > LARGEST:
        raise AcwmError(f"the pictures have {size / 2**20:.1f} MB: lower QUALITY or CELL")


if __name__ == "__main__":
    try:
        main()
    except AcwmError as error:
        sys.exit(str(error))
