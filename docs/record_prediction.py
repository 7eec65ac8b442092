"""Write prediction.webp, the first picture of README.md: `python docs/record_prediction.py`.

A simulated test episode, drawn large, beside what the model that ships gets of it and what it
predicts. The model is right or wrong as it is: its frames are only enlarged.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acwm_core.data.card import DatasetCard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from acwm_zoo.shipped import folder

OUT = Path(__file__).resolve().parent / "prediction.webp"
MODEL, EPISODE = "push_cube", 0
FRAMES, EVERY, MILLISECONDS, QUALITY = 66, 1, 100, 62  # of the episode; of the animation
LARGEST = 1_000_000  # bytes
LARGE, SMALL, GIVEN, STRIP, GAP = 480, 288, 160, 24, 12  # pixels
GETS, PREDICTS = "Given: one frame and the actions", "Predicted by the model, at {0} by {0}"
INK, PALE, COLOURS = "#1b1d22", "#c4c4c0", ("#2450d8", "#c2560c", "#0b7d63", "#9b2fae")
FONT = ImageFont.load_default(size=14)

Video = NDArray[np.uint8]  # [T, H, W, 3]


def main() -> None:
    """Simulate in both sizes, predict, compose and write."""
    run = RunFolder(folder(MODEL))
    card = DatasetCard.read(run.card)
    given, actions = film(card, {})
    large, _ = film(card, {"size": [LARGE, LARGE]})
    model = load_run(folder(MODEL)).world_model
    first = torch.from_numpy(given[:1]).permute(0, 3, 1, 2).float() / 255
    predicted = model.rollout(first, torch.from_numpy(actions)[None], check=False)[0]
    made = (255 * predicted.permute(0, 2, 3, 1)).round().byte().numpy()
    shares = heights(actions[:FRAMES])
    first_picture, *others = [
        composed(large[t], given[0], made[t], shares, t) for t in range(0, FRAMES, EVERY)
    ]
    first_picture.save(
        OUT, save_all=True, append_images=others, duration=MILLISECONDS, loop=0,
        quality=QUALITY, method=6,
    )  # fmt: skip
    size = OUT.stat().st_size
    print(f"{OUT.name}: {1 + len(others)} pictures of {first_picture.size}, {size / 1e6:.2f} MB")
    if size > LARGEST:
        raise SystemExit(f"that is more than {LARGEST / 1e6} MB: lower QUALITY or FRAMES")


def film(card: DatasetCard, options: dict[str, list[int]]) -> tuple[Video, NDArray[np.float32]]:
    """Frames and actions of the episode; its size changes nothing of what happens."""
    environment = make_environment(card.environment.name, {**card.options, **options})
    episode = simulate(environment, card.spec("ind_test", EPISODE))
    environment.close()
    return episode.video, episode.actions


def heights(actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Actions `[T, A]`, each over its own range: 0 for the highest, 1 for the lowest."""
    high, low = actions.max(0), actions.min(0)
    return (high - actions) / np.maximum(high - low, 1e-6)


def composed(
    simulated: Video, given: Video, made: Video, shares: NDArray[np.floating], now: int
) -> Image.Image:
    """One picture: the simulator on the left; what the model gets and predicts on the right.

    Args:
        shares: the actions' `heights`.
        now: number of the frame that is shown.
    """
    picture = Image.new("RGB", (LARGE + GAP + SMALL, STRIP + LARGE), "white")
    pen, right, low = ImageDraw.Draw(picture), LARGE + GAP, STRIP + LARGE - SMALL
    titles = (
        (0, 0, f"Simulated, and drawn at {LARGE} by {LARGE}"),
        (right, 0, GETS),
        (right, low - STRIP, PREDICTS.format(len(made))),
    )
    for x, y, text in titles:
        pen.text((x, y + 2), text, fill=INK, font=FONT)
    picture.paste(Image.fromarray(simulated), (0, STRIP))
    picture.paste(_enlarged(given, GIVEN), (right, STRIP))
    picture.paste(_enlarged(made, SMALL), (right, low))
    left, width, height = right + GIVEN + GAP, SMALL - GIVEN - GAP, GIVEN / shares.shape[1]
    for index, colour in enumerate(COLOURS[: shares.shape[1]]):
        x = left + np.arange(len(shares)) / len(shares) * width
        y = STRIP + height * (index + 0.1 + 0.8 * shares[:, index])
        pen.line([*zip(x.tolist(), y.tolist(), strict=True)], fill=PALE)
        pen.line(
            [*zip(x[: now + 1].tolist(), y[: now + 1].tolist(), strict=True)], fill=colour, width=2
        )
    at = left + now / len(shares) * width
    pen.line([(at, STRIP), (at, STRIP + GIVEN)], fill=INK)
    return picture


def _enlarged(frame: Video, side: int) -> Image.Image:
    return Image.fromarray(frame).resize((side, side), Image.Resampling.BICUBIC)


if __name__ == "__main__":
    main()
