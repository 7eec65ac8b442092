"""Other ways to load the clips of a dataset, as usually written with common libraries."""

from __future__ import annotations

import io
import itertools
import random
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from acwm_core.data.clips import ClipDataset, padded_video, window_actions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.video import Encoding, decode_planes, encode_frames

MP4 = Encoding("rgb24", "yuv420p", "libx264", {"crf": "30", "bf": "0"}, "mp4")
MP4_KEYFRAMES = 2  # as in LeRobot: every second frame is a key frame

Pair = tuple[torch.Tensor, torch.Tensor]


def webdataset_loader(episodes: EpisodeDataset, frames: int, stride: int, **loading: Any) -> Any:
    """Stream episodes from the same tars, cut a random window from each, shuffle in a buffer."""
    import webdataset

    def window(sample: dict[str, Any]) -> Pair:
        actions = np.load(io.BytesIO(sample["actions.npy"]))
        start = random.randrange(0, max(1, len(actions) - frames + 1), stride)
        video = decode_planes(sample["video.mkv"], start, min(start + frames, len(actions)))
        return pair(video, actions, start, frames)

    shards = [str(path) for path in sorted((episodes.path / episodes.split).glob("*.tar"))]
    pipeline = webdataset.WebDataset(shards, shardshuffle=len(shards), empty_check=False)
    loading["num_workers"] = min(loading["num_workers"], len(shards))
    return DataLoader(pipeline.shuffle(64).map(window), **kept_alive(loading))


def pair(video: NDArray[np.uint8], actions: NDArray[np.float32], start: int, frames: int) -> Pair:
    """A clip of video ``[T, 3, H, W]`` and its actions, as tensors."""
    return (
        torch.from_numpy(padded_video(video, frames)),
        torch.from_numpy(window_actions(actions, start, frames)),
    )


class Windows(Dataset[Pair]):
    """The windows of `clips`, read by a subclass from its own file."""

    def __init__(self, clips: ClipDataset, path: Path) -> None:
        self.windows, self.frames = clips.windows.tolist(), clips.frames
        self.lengths, self.path = clips.episodes.lengths, path
        self.file: Any = None

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> Pair:
        episode, start = self.windows[index]
        return self.read(episode, start, min(start + self.frames, self.lengths[episode]))

    def read(self, episode: int, start: int, stop: int) -> Pair:
        """The clip of `episode` from frame `start` to `stop`."""
        raise NotImplementedError

    def loader(self, **loading: Any) -> Any:
        """A loader of batches in random order."""
        return DataLoader(self, shuffle=True, **kept_alive(loading))


class Hdf5Windows(Windows):
    """One HDF5 file with a dataset ``[T, H, W, 3]`` per episode, in chunks of one frame."""

    def read(self, episode: int, start: int, stop: int) -> Pair:
        """Read a slice; the file is opened once per process."""
        self.file = self.file or h5py.File(self.path, "r")
        group = self.file[str(episode)]
        video = np.ascontiguousarray(group["video"][start:stop].transpose(0, 3, 1, 2))
        return pair(video, group["actions"][:], start, self.frames)

    @classmethod
    def write(cls, clips: ClipDataset, path: Path, **compression: Any) -> Hdf5Windows:
        """Write the episodes to HDF5."""
        with h5py.File(path, "w") as file:
            for number, episode in enumerate(clips.episodes):
                group = file.create_group(str(number))
                chunks = (1, *episode.video.shape[1:])
                group.create_dataset("video", data=episode.video, chunks=chunks, **compression)
                group.create_dataset("actions", data=episode.actions)
        return cls(clips, path)


class Mp4Windows(Windows):
    """One MP4 with all episodes in a row, as in LeRobot 3; reading seeks, decodes, converts to RGB.

    The settings are LeRobot's except for the codec, which is H.264 here: a key frame every two
    frames, crf 30, yuv420p. The video is lossy. It is opened for every clip, as in LeRobot's PyAV
    reader.
    """

    actions: list[NDArray[np.float32]]

    def read(self, episode: int, start: int, stop: int) -> Pair:
        """Seek to the key frame before the clip and decode to its end."""
        first = sum(self.lengths[:episode]) + start
        frames = np.stack(list(self.decoded(first, stop - start)))
        video = np.ascontiguousarray(frames.transpose(0, 3, 1, 2))
        return pair(video, self.actions[episode], start, self.frames)

    def decoded(self, first: int, count: int) -> Iterator[NDArray[np.uint8]]:
        """Yield `count` frames `[H, W, 3]`, starting with number `first`."""
        source: Any
        with av.open(str(self.path)) as source:
            stream = source.streams.video[0]
            stream.codec_context.thread_count = 1
            tick = float(stream.time_base * stream.average_rate)
            source.seek(round(first / tick), stream=stream)
            wanted = (f for f in source.decode(stream) if round(f.pts * tick) >= first)
            for frame in itertools.islice(wanted, count):
                yield frame.to_ndarray(format="rgb24")

    @classmethod
    def write(cls, clips: ClipDataset, path: Path) -> Mp4Windows:
        """Encode the episodes to MP4."""
        height, width = clips.episodes.card.environment.frame_size
        fps = clips.episodes.card.environment.fps
        frames = itertools.chain.from_iterable(episode.video for episode in clips.episodes)
        path.write_bytes(encode_frames(frames, (height, width), MP4, fps, MP4_KEYFRAMES))
        windows = cls(clips, path)
        windows.actions = [clips.episodes.actions(index) for index in range(len(clips.episodes))]
        return windows


def kept_alive(loading: dict[str, Any]) -> dict[str, Any]:
    """Add the option that workers stay alive between passes, as ours do."""
    return {**loading, "persistent_workers": loading["num_workers"] > 0}


def batches_of(loader: Iterable[Any]) -> Iterator[int]:
    """Yield the number of clips per batch of a loader, over endless passes."""
    while True:
        for batch in loader:
            first = next(iter(batch.values())) if isinstance(batch, dict) else batch[0]
            yield len(first)
