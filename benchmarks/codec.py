"""Reconstruction PSNR of a codec on freshly simulated episodes of push_cube.

    python benchmarks/codec.py            # the table in docs/codecs.md
    python benchmarks/codec.py --codec identity

The episodes have a seed that no training used. PSNR is that of the mean squared error pooled over
the first 37 frames of all episodes.
"""

import math

import click
import torch

from acwm_core.catalog import catalog
from acwm_core.codec import Codec
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
from acwm_core.episode import EpisodeSpec, Split

FRAMES = 37
SEED = 12345


def reconstruction_psnr(
    codec: Codec, environment: Environment, split: Split, episodes: int
) -> float:
    """Pooled PSNR in dB over `episodes` episodes of a split."""
    errors: list[float] = []
    for index in range(episodes):
        spec = EpisodeSpec("push_cube", split, index, seed=SEED)
        video = torch.from_numpy(simulate(environment, spec).video[:FRAMES])
        video = video.permute(0, 3, 1, 2)[None].float() / 255
        with torch.inference_mode():
            errors.append((codec(video) - video).square().mean().item())
    return -10 * math.log10(sum(errors) / len(errors))


@click.command()
@click.option("--codec", "name", default="compact", show_default=True)
@click.option(
    "--episodes", default=40, show_default=True, help="Per split at 64×64; a quarter at 240×240."
)
def main(name: str, episodes: int) -> None:
    """Print the table."""
    codec: Codec = catalog().create("codec", name)
    print(f"{name} {codec.fingerprint()}: PSNR in dB of the reconstruction")
    for size, count in ((64, episodes), (240, max(1, episodes // 4))):
        environment = catalog().create("environment", "push_cube", size=size)
        for split in ("ind_test", "ood_test"):
            psnr = reconstruction_psnr(codec, environment, split, count)
            print(f"{size}×{size} {split} ({count} episodes): {psnr:.2f}")


if __name__ == "__main__":
    main()
