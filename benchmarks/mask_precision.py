"""How precisely outlines must be known for masks of a certain IoU.

    python benchmarks/mask_precision.py

Draws frames of test episodes ten times as large as usual and takes the masks of small frames from
them, once unchanged and once with everything shifted by 0.1 to 0.3 of a small pixel. The IoU of the
two is the best that an estimator with this error can reach (docs/findings/estimators.md).
"""

from __future__ import annotations

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_estimators.layout import layout_of

LARGER = 10
"""Scale of the large frames relative to the small ones."""

WORLDS = (
    "push_cube", "stack_cube", "push_rope", "cloth_move",
    "push_sand", "pour_water", "robot_arm", "reacher",
)  # fmt: skip


@click.command()
@click.argument("worlds", nargs=-1)
@click.option("--size", default=64, show_default=True, help="height of the small frames")
@click.option("--episodes", default=4, show_default=True)
@click.option("--frames", default=9, show_default=True, help="of each episode, the first ones")
def main(worlds: tuple[str, ...], size: int, episodes: int, frames: int) -> None:
    """Print the mean IoU of instances for outlines that are off by 0.1 to 0.3 pixels."""
    shifts = (1, 2, 3)
    table = Table("environment", *(f"{shift / LARGER} px" for shift in shifts))
    for world in worlds or WORLDS:
        masks = large_masks(world, size, episodes, frames)
        ious = [mean_iou(masks, shift) for shift in shifts]
        table.add_row(world, *(f"{iou:.3f}" for iou in ious))
    Console().print(table)


def large_masks(world: str, size: int, episodes: int, frames: int) -> NDArray[np.uint8]:
    """Masks `[N, LARGER · size, LARGER · W]` of the instances that estimators read; else 0."""
    environment = make_environment(world, {"size": LARGER * size})
    names = environment.card.instances
    read = np.isin(np.arange(256), [names.index(name) for name in layout_of(world).instances])
    found: list[NDArray[np.uint8]] = []
    for index in range(episodes):
        spec = EpisodeSpec(world, "ind_test", index, options={"size": LARGER * size})
        masks = simulate(environment, spec, frames=frames).masks
        found.append(np.where(read[masks], masks, 0).astype(np.uint8))
    return np.concatenate(found)


def mean_iou(masks: NDArray[np.uint8], shift: int) -> float:
    """Mean IoU over instances, pooled over frames, for shifts to the right and down."""
    ious: list[float] = []
    for right, down in ((shift, 0), (0, shift)):
        middle = LARGER // 2
        true = masks[:, middle::LARGER, middle::LARGER]
        moved = masks[:, middle + down :: LARGER, middle + right :: LARGER]
        for instance in np.unique(true[true > 0]):
            a, b = true == instance, moved == instance
            ious.append((a & b).sum() / (a | b).sum())
    return float(np.mean(ious))


if __name__ == "__main__":
    main()
