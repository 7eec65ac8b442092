"""One prediction on request: from a first frame and actions of one's choice to a video file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.video import write_mp4
from acwm_core.environment import ActionSpec
from acwm_core.episode import SPLITS
from acwm_core.errors import ActionError, DataError, RecipeError, suggest
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.videos import contact_sheet, join, magnification, panels, to_pixels
from acwm_core.shapes import Clip
from acwm_core.training.run import load_run


def rollout_run(
    run: str | Path,
    out: str | Path,
    *,
    data: str | Path | None = None,
    split: str = "ind_test",
    episode: int = 0,
    actions: str | Path | None = None,
    image: str | Path | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "auto",
) -> Path:
    """Predict one video with a trained run and write it as MP4, or as a sheet of frames in PNG.

    The first frame and the actions are those of a recorded episode, unless others are given. With
    the episode's own of both, the video shows truth | prediction | difference, else the
    prediction alone.

    Args:
        run: the run folder.
        out: the ``.mp4`` or ``.png`` to write.
        data: the data folder of the episode; the recipe's by default.
        split: split of the episode.
        episode: its number.
        actions: a ``.npy`` file of raw actions `[N, A]`; every row leads to one more frame.
        image: a picture to start from; it is resized to the frame size of the environment.
        steps: sampling steps; the flow's own by default.
        seed: of the sampling noise.
        device: where the model runs; ``"auto"`` takes a GPU if there is one.

    Returns:
        `out`.

    Raises:
        TrainingError: the folder holds no trained run.
        RecipeError: no such split or device, or a file name that is neither video nor picture.
        DataError: no such episode, or a file that cannot be read.
        ActionError: actions of the wrong shape, not finite, or out of bounds.
    """
    out = _checked_name(Path(out))
    bundle = load_run(run)
    first, rows, truth = None, None, None
    if actions is None or image is None:
        truth, rows = _recorded(data or bundle.recipe.data["path"], split, episode)
        first = truth[0]
    if image is not None:
        first, truth = _read_image(Path(image), bundle.card.frame_size), None
    if actions is not None:
        rows, truth = _read_actions(Path(actions), bundle.card.action), None
    assert first is not None
    assert rows is not None
    model = bundle.world_model.to(choose_device(device))
    where = model.action_low.device
    with torch.inference_mode():
        prediction = model.rollout(
            first[None].to(where),
            torch.tensor(rows)[None].to(where),
            steps=steps,
            window=bundle.recipe.data["clip_frames"],
            seeds=[seed],
        )[0].cpu()
    shown = [to_pixels(prediction)] if truth is None else panels(truth, prediction)
    _write(out, shown, bundle.card.fps)
    return out


def _checked_name(out: Path) -> Path:
    if out.suffix not in (".mp4", ".png"):
        raise RecipeError(f"{out}: end its name in .mp4 for a video or .png for a sheet of frames")
    return out


def _write(out: Path, shown: list[NDArray[np.uint8]], fps: int) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    scale = magnification(shown[0].shape[1])
    if out.suffix == ".mp4":
        write_mp4(out, join(shown), fps, scale)
        return
    sheet = contact_sheet(shown)
    Image.fromarray(sheet.repeat(scale, 0).repeat(scale, 1)).save(out)


def _recorded(path: str | Path, split: str, episode: int) -> tuple[Clip, NDArray[np.float32]]:
    if split not in SPLITS:
        raise RecipeError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    dataset = EpisodeDataset(path, split)
    if not 0 <= episode < len(dataset):
        raise DataError(
            f"{split} of {path} has no episode {episode}: it has 0 to {len(dataset) - 1}"
        )
    video = torch.tensor(dataset.video(episode)).float() / 255
    return video, dataset.actions(episode)


def _read_image(path: Path, size: tuple[int, int]) -> torch.Tensor:
    """`[3, H, W]` in [0, 1]."""
    height, width = size
    try:
        with Image.open(path) as picture:
            resized = picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    except OSError as error:  # also what Pillow raises for a file that is no picture
        raise DataError(f"{path} cannot be read as a picture: {error}") from error
    return torch.tensor(np.asarray(resized)).permute(2, 0, 1).float() / 255


def _read_actions(path: Path, spec: ActionSpec) -> NDArray[np.float32]:
    """Rows `[N + 1, A]`; the last is zero and leads nowhere."""
    try:
        rows = np.load(path, allow_pickle=False).astype(np.float32)
    except (OSError, ValueError, EOFError, AttributeError) as error:
        raise DataError(f"{path} cannot be read as a .npy array: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != spec.size or not len(rows):
        names = ", ".join(spec.names)
        raise ActionError(f"{path} is of shape {rows.shape}, not (N, {spec.size}): {names}")
    if not np.all((rows >= spec.low) & (rows <= spec.high)):  # so NaN is refused too
        raise ActionError(f"{path} leaves the bounds of the action, {spec.low} to {spec.high}")
    return np.concatenate([rows, np.zeros((1, spec.size), np.float32)])
