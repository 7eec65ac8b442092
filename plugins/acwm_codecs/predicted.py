"""What trained models predict of training episodes: latents that a decoder can learn from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Episode
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import as_clip
from acwm_core.executors import progress_bar
from acwm_core.model.codec import Codec
from acwm_core.model.world_model import WorldModel
from acwm_core.training.run import RunBundle, load_run, read_metadata
from acwm_core.training.run_folder import RunFolder


class EpisodePredictor:
    """Predicts the training episodes of datasets, each by the model of its world and frame size.

    Args:
        runs: runs or trained models; none leaves all datasets without predictions.
        codec: its latents are those that the models must predict.

    Raises:
        DataError: a model predicts other latents, or there are two of one world.
    """

    def __init__(self, runs: Sequence[Path], codec: Codec) -> None:
        self._models: dict[str, tuple[Path, RunBundle]] = {}
        for run in runs:
            bundle = load_run(run)
            world = bundle.card.name
            if world in self._models:
                raise DataError(f"{self._models[world][0]} and {run} both predict {world}")
            _check_latents(run, bundle.world_model.codec, codec)
            self._models[world] = run, bundle
        self._used: set[str] = set()

    def of(self, folder: Path, most: int) -> list[NDArray[np.float16]]:
        """The predicted latents of up to `most` episodes; none if there is no model for them."""
        episodes = EpisodeDataset(folder, "train")
        card = episodes.card.environment
        if card.name not in self._models:
            return []
        _, bundle = self._models[card.name]
        if bundle.card.frame_size != card.frame_size:
            return []
        self._used.add(card.name)
        model, number = bundle.world_model, min(most, len(episodes))
        made: list[NDArray[np.float16]] = []
        with progress_bar(f"predicting {folder.name}", number) as report:
            for index in range(number):
                made.append(_predict(model, episodes[index], index))
                report(1)
        return made

    def record(self) -> list[dict[str, Any]]:
        """Which models were used.

        Raises:
            DataError: one of them was not, as there are no data of its world.
        """
        for world, (run, bundle) in self._models.items():
            if world not in self._used:
                size = "×".join(map(str, bundle.card.frame_size))
                raise DataError(f"{run} predicts {world} at {size}, of which no data was given")
        return [
            {"model": run.name, "sha256": read_metadata(RunFolder(run).weights)["sha256"]}
            for run, _ in self._models.values()
        ]


def _predict(model: WorldModel, episode: Episode, seed: int) -> NDArray[np.float16]:
    """The latents of all whole latent frames; of one clip, if the model does not stream."""
    frames, stride = len(episode.video), model.codec.temporal_stride
    if model.mode != "stream":
        frames = min(frames, model.clip_frames)
    whole = model.codec.video_frames(1 + (frames - 1) // stride)
    given = as_clip(episode.video[: model.context_frames])[None]
    actions = torch.from_numpy(episode.actions[:whole])[None]
    return model.predict_latents(given, actions, seeds=[seed])[0].numpy().astype(np.float16)


def _check_latents(run: Path, codec: Codec, own: Codec) -> None:
    side = 8 * max(codec.spatial_stride, own.spatial_stride)
    video = torch.rand(1, 1, 3, side, side, generator=torch.Generator().manual_seed(0))
    if not torch.equal(codec.encode(video), own.encode(video)):
        raise DataError(f"{run} predicts the latents of another codec: start from its codec")
