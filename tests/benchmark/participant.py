"""A participant: reads the tasks by itself, and writes what a run's model predicts of them."""

import json

import av
import numpy as np
import torch
from PIL import Image

from acwm_core.evaluation.clips import draw_seeds
from acwm_core.training.run import load_run


def predict(run, tasks, out, kind, draws=1):
    """Predict all tasks; of branches one draw."""
    model = load_run(run).world_model
    for line in (tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        images = [np.asarray(Image.open(tasks / name)) for name in task["images"]]
        given = torch.as_tensor(np.stack(images)).permute(0, 3, 1, 2)[None].float() / 255
        actions = torch.as_tensor(np.load(tasks / task["actions"])["actions"])[None]
        number = 1 if task["branch"] else draws
        for draw, seed in enumerate(draw_seeds(task["seed"], number)):
            video = model.rollout(given, actions, seeds=[seed], check=False)
            assert video.shape[1] == task["frames"]
            path = out / (task["id"] + f".{draw}" * (number > 1))
            path.parent.mkdir(parents=True, exist_ok=True)
            WRITERS[kind](path, video[0].permute(0, 2, 3, 1).numpy())
    return out


def to_png(path, video):
    path.mkdir()
    for number, image in enumerate((video * 255).round().astype(np.uint8)):
        Image.fromarray(image).save(path / f"{number}.png")


def to_npz(path, video):
    np.savez(path.with_name(path.name + ".npz"), video=video)


def to_video(container, codec, pixels, rate=10, **options):
    def write(path, video):
        with av.open(str(path.with_name(path.name + container)), "w") as file:
            stream = file.add_stream(codec, rate=rate, options=options)
            stream.height, stream.width = video.shape[1:3]
            stream.pix_fmt = pixels
            for image in (video * 255).round().astype(np.uint8):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            file.mux(stream.encode(None))

    return write


def to_gif(path, video):
    images = [Image.fromarray(image) for image in (video * 255).round().astype(np.uint8)]
    images[0].save(
        path.with_name(path.name + ".gif"), save_all=True, append_images=images[1:], duration=100
    )


WRITERS = {
    "png": to_png,
    "npz": to_npz,
    "gif": to_gif,
    "mp4": to_video(".mp4", "libx264", "yuv420p"),
    "mkv": to_video(".mkv", "ffv1", "bgr0"),
    "webm": to_video(".webm", "libvpx-vp9", "yuv420p", crf="30", b="0"),
}
