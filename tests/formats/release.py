"""A synthetic folder in the layout of the published release, written without acwm's exporter."""

import av
import numpy as np
import torch

SPLITS = {"ind_train": 5, "ind_test": 2, "ood_test": 2}


def video(path, frames, fps=10, **options):
    """Write ``[T, H, W, 3]`` as an MP4 of near-lossless H.264."""
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=fps)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "1", **options}
        for frame in frames:
            output.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        output.mux(stream.encode(None))


def moving_square(rng, length, size, action_size=2):
    """A bright square that moves by its action, which lies in [-1, 1]."""
    height, width = size
    side = height // 4
    frames = np.full((length, height, width, 3), 40, np.uint8)
    frames[:, :, :, 1] = np.linspace(30, 90, width).astype(np.uint8)
    position = np.array([height, width]) * rng.uniform(0.2, 0.6, 2)
    actions = rng.uniform(-1, 1, (length, action_size)).astype(np.float32)
    for frame, action in zip(frames, actions, strict=True):
        row, column = position.astype(int)
        frame[row : row + side, column : column + side] = (230, 120, 40)
        position = np.clip(position + 4 * action[:2], 0, np.array(size) - side)
    return frames, actions


def environment(folder, *, size=(64, 64), length=12, action_size=2, seed=0, splits=SPLITS):
    """One environment's folder; returns ``{split: [(frames, actions), …]}``."""
    rng, made = np.random.default_rng(seed), {}
    for split, count in splits.items():
        place = folder / split
        place.mkdir(parents=True)
        made[split] = [moving_square(rng, length, size, action_size) for _ in range(count)]
        entries = []
        for index, (frames, actions) in enumerate(made[split]):
            name = f"episode_{index}.mp4"
            video(place / name, frames)
            entries.append(
                {
                    "video_path": f"/mnt/elsewhere/{split}/{name}",
                    "actions": torch.tensor(actions),
                    "length": length,
                    "seed": np.int64(index),
                    "episode_idx": index,
                }
            )
        torch.save(entries, place / "metadata.pt")
    return made


def rewrite(folder, change):
    """Change the entries of a split's metadata."""
    entries = torch.load(folder / "metadata.pt", weights_only=False)
    change(entries)
    torch.save(entries, folder / "metadata.pt")
