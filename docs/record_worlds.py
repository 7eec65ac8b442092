"""Write worlds.webp, one episode per environment side by side: `python docs/record_worlds.py`.

The behaviour policy acts; every second frame of the first four seconds is kept.
"""

import numpy as np
from build_environments import DOCS, MOMENT, MOMENTS, record
from environments_text import ORDER
from PIL import Image

from acwm_core.data.simulate import make_environment
from acwm_formats.sheets import Label, play_together

OUT = DOCS / "worlds.webp"
SIDE, FRAMES, EVERY, FPS, QUALITY = 160, 40, 2, 10, 60


def main() -> None:
    """Simulate, crop to squares and write."""
    videos = []
    for name in ORDER:
        env = make_environment(name)
        split, index, _ = MOMENTS.get(name, MOMENT)
        frames = record(env, split, index, FRAMES)[1][::EVERY]
        env.close()
        left = (frames.shape[2] - frames.shape[1]) // 2
        squares = frames[:, :, left : left + frames.shape[1]]
        small = [Image.fromarray(square).resize((SIDE, SIDE)) for square in squares]
        videos.append(np.stack([np.asarray(each) for each in small]))
        print(name, flush=True)
    first, *others = map(
        Image.fromarray, play_together([Label(n) for n in ORDER], videos, across=4)
    )
    first.save(
        OUT, save_all=True, append_images=others, duration=1000 * EVERY // FPS, loop=0,
        quality=QUALITY, method=6,
    )  # fmt: skip
    print(f"{OUT.name}: {OUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
