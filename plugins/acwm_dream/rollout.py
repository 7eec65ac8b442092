"""Writes one prediction as a video file, from a chosen first frame and chosen actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from acwm_core.arrays import load_npy
from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import moments, strip, to_pixels
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.data.video import write_mp4
from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.env.episode import SPLITS, Split
from acwm_core.errors import (
    DataError,
    RecipeError,
    ShapeError,
    TrainingError,
    suggest,
)
from acwm_core.evaluation import videos
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.evaluate import check_environment, choose_device
from acwm_core.evaluation.results import DIVIDER
from acwm_core.files import written_whole
from acwm_core.model.shapes import Clip, Video, check_pixels
from acwm_core.model.world_model import Mode
from acwm_core.plugins import catalog
from acwm_core.training.run import RunBundle, load_run
from acwm_core.training.run_folder import RunFolder, find_run
from acwm_dream.captions import enlarged
from acwm_formats.images import picture_of_size

COLUMNS = 8
"""Most frames of a strip."""

Panels = tuple[NDArray[np.uint8], ...]
"""The panels of one frame, `[H, W, 3]` each."""


def rollout_run(
    run: str | Path,
    out: str | Path,
    *,
    data: str | Path | None = None,
    split: str = "ind_test",
    episode: int = 0,
    actions: str | Path | None = None,
    image: str | Path | None = None,
    mode: Mode | None = None,
    steps: int | None = None,
    seed: int = 0,
    samples: int = 1,
    device: str = "auto",
) -> Path:
    """Predict one video with a trained run and write it as MP4, or as a sheet of frames in PNG.

    By default, the context frames (as many as the model was trained with) and the actions come from
    a recorded episode. The video then shows truth | prediction | difference, one below the other if
    a frame shows several views. With other actions or another picture, it shows the prediction
    only. Several draws stand side by side, after the truth if it is known.

    Args:
        run: the run folder.
        out: the ``.mp4`` or ``.png`` to write.
        data: the data folder of the episode; that of the recipe by default. If the latter does not
            exist, the same episode is simulated.
        split, episode: split and number of the episode.
        actions: a ``.npy`` file with raw actions `[N, A]`; every row leads to one more frame.
        image: a picture to start from, resized to the environment's frame size; only for models
            with a single context frame.
        mode: how a long video is predicted; the model's own mode by default. Windows and streams
            take any number of actions in constant memory.
        steps: sampling steps; the flow's own number by default.
        seed: seed of the sampling noise; of several draws, the first one's, and they count up.
        samples: number of draws to show, of a model that draws.
        device: device of the model; ``"auto"`` takes a GPU if there is one.

    Returns:
        `out`.

    Raises:
        TrainingError: the folder holds no trained run, or the prediction is not finite.
        RecipeError: the split, mode, device or file ending is unknown, or the model does not
            support the request.
        DataError: the episode does not exist or is too short, or a file cannot be read.
        ShapeError: the actions have the wrong shape, are not finite, or are out of bounds.
    """
    out = Path(out)
    if out.suffix not in (".mp4", ".png"):
        raise RecipeError(f"{out}: end its name in .mp4 for a video or .png for a sheet of frames")
    if mode not in (None, *get_args(Mode)):
        raise RecipeError(f"unknown mode {mode!r}{suggest(mode, get_args(Mode))}")
    if split not in SPLITS:
        raise RecipeError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    bundle = load_run(run)
    given, rows, truth = None, None, None
    if actions is None or image is None:
        truth, rows = _recorded(find_run(run), bundle, data, split, episode)
        given = truth[: bundle.world_model.context_frames]
    if image is not None:
        given, truth = _read_start(Path(image), bundle), None
    if actions is not None:
        rows, truth = _with_chosen(Path(actions), rows, bundle), None
    assert given is not None
    assert rows is not None
    model = bundle.world_model.to(choose_device(device))
    where = model.action_low.device
    if samples > 1 and not model.samples:
        raise RecipeError(
            f"this model is deterministic: all {samples} predictions would be "
            "equal, so omit --samples"
        )
    inputs = torch.tensor(rows)[None].to(where)
    check_pixels(given)
    model.checked(inputs[:, :-1])
    chunks = model.rollout_chunks(
        given[None].expand(samples, *[-1] * given.ndim).to(where),
        inputs.expand(samples, -1, -1),
        mode=mode,
        steps=steps,
        seeds=range(seed, seed + samples),
    )
    _write(out, _frames(chunks, truth), len(rows), bundle.card)
    return out


def _recorded(
    run: Path, bundle: RunBundle, data: str | Path | None, split: Split, episode: int
) -> tuple[Clip, NDArray[np.float32]]:
    """The episode's video and actions; without a dataset it is simulated."""
    folder = data or bundle.recipe.data["path"]
    if data or ":" in str(folder) or (Path(folder) / CARD).exists():
        video, rows = _read_episode(EpisodeDataset(folder, split), episode, bundle.card)
    else:
        video, rows = _simulate_episode(DatasetCard.read(RunFolder(run).card), split, episode)
    context = bundle.world_model.context_frames
    if len(video) <= context:
        raise DataError(f"episode {episode} has {len(video)} frames, but {context} are given")
    return video, rows


def _read_start(image: Path, bundle: RunBundle) -> Clip:
    context = bundle.world_model.context_frames
    if context > 1:
        raise RecipeError(f"this model starts from {context} frames, but --image gives one")
    return as_clip(picture_of_size(image, bundle.card.frame_size)[None])


def _with_chosen(
    actions: Path, rows: NDArray[np.float32] | None, bundle: RunBundle
) -> NDArray[np.float32]:
    """The chosen actions, after those between the given frames, of the recorded `rows`."""
    chosen = _read_actions(actions, bundle.card.action)
    if rows is None:
        return chosen
    return np.concatenate([rows[: bundle.world_model.context_frames - 1], chosen])


def _frames(chunks: Iterator[Video], truth: Clip | None) -> Iterator[Panels]:
    """The panels of each frame: the prediction, between truth and difference if truth is known.

    Several draws `[N, T, 3, H, W]` follow the truth, without differences.
    """
    start = 0
    for chunk in chunks:
        draws = chunk.cpu()
        if not draws.isfinite().all():
            raise TrainingError(
                f"the prediction is not finite from frame {start} on: train the model again with "
                "a lower training.learning_rate"
            )
        true = None if truth is None else truth[start : start + draws.shape[1]]
        parts = [to_pixels(clip) for clip in draws]
        if true is not None and len(draws) == 1:
            parts = videos.panels(true, draws[0])
        elif true is not None:
            parts = [to_pixels(true), *parts]
        yield from zip(*parts, strict=True)
        start += draws.shape[1]


def _write(out: Path, frames: Iterator[Panels], count: int, card: EnvironmentCard) -> None:
    """Write the file; only one chunk of the video is in memory at a time."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".mp4":
        joined = (videos.join_panels(frame, down=bool(card.views)) for frame in frames)
        write_mp4(out, (enlarged(each, card) for each in joined), card.fps)
    else:
        numbers = moments(count, COLUMNS)
        selection = [frame for index, frame in enumerate(frames) if index in numbers]
        strip = frame_strip([np.stack(panel) for panel in zip(*selection, strict=True)])
        with written_whole(out) as partial:
            Image.fromarray(enlarged(strip, card)).save(partial, out.suffix[1:])


def frame_strip(panels: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """A picture of evenly spaced frames of a clip, with one row per panel `[T, H, W, 3]`."""
    return strip(panels, COLUMNS, gap=DIVIDER, colour=videos.DARK)


def _read_episode(
    dataset: EpisodeDataset, episode: int, card: EnvironmentCard
) -> tuple[Clip, NDArray[np.float32]]:
    check_environment(dataset, card)
    if not 0 <= episode < len(dataset):
        raise DataError(
            f"{dataset.split} of {dataset.path} has no episode {episode}: it has 0 to "
            f"{len(dataset) - 1}"
        )
    return torch.tensor(dataset.video(episode)).float() / 255, dataset.actions(episode)


def _simulate_episode(
    card: DatasetCard, split: Split, episode: int
) -> tuple[Clip, NDArray[np.float32]]:
    """Simulate the episode that the dataset would contain."""
    if episode < 0:
        raise DataError(f"episode {episode}: give 0 or more")
    name = card.environment.name
    if card.source or name not in catalog().registry("environment"):
        raise DataError(f"no simulator of {name} is installed: give a dataset of it with --data")
    simulated = simulate(make_environment(name, card.options), card.spec(split, episode))
    return as_clip(simulated.video), simulated.actions


def _read_actions(path: Path, spec: ActionSpec) -> NDArray[np.float32]:
    """Read actions as `[N + 1, A]`; the last row is zero, and no frame follows it."""
    try:
        rows = load_npy(path).astype(np.float32)
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"{path} cannot be read as a .npy array: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != spec.size or not len(rows):
        names = ", ".join(spec.names)
        raise ShapeError(f"{path} is of shape {rows.shape}, not (N, {spec.size}): {names}")
    low, high = np.array([spec.low, spec.high], np.float32)  # rounded as the rows are
    if not np.all((rows >= low) & (rows <= high)):  # so NaN is refused too
        raise ShapeError(f"{path} has actions outside their bounds, {spec.low} to {spec.high}")
    return np.concatenate([rows, np.zeros((1, spec.size), np.float32)])
