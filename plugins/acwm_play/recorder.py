"""Recordings: saves what was played as an episode of a dataset, and as a video of both worlds."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import CARD, DatasetCard, other_dataset, package_versions
from acwm_core.data.dataset import Manifest, action_statistics
from acwm_core.data.pictures import magnification
from acwm_core.data.readme import write_readme
from acwm_core.data.shards import shard_name, write_shard
from acwm_core.data.video import write_mp4
from acwm_core.env.card import check_episode
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.videos import join_panels, panels
from acwm_core.files import held, inside, writing
from acwm_core.plugins import catalog
from acwm_play.simulator import TimeStep

MAX_FRAMES = 1201
"""Largest number of frames in a recording: two minutes at ten frames per second."""

NOTE = (
    "Played by a person beside a world model; the frames, states and masks are the simulator's. "
    "An episode may begin in the middle of a scene."
)

_writing = threading.Lock()


@dataclass
class PlayedEpisode:
    """A recording in progress.

    Attributes:
        time_steps: the simulator's data of each frame.
        model_frames: the model's frames, `[H, W, 3]` uint8 each.
    """

    time_steps: list[TimeStep] = field(default_factory=list[TimeStep])
    model_frames: list[NDArray[np.uint8]] = field(default_factory=list[NDArray[np.uint8]])

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.time_steps)

    def episode(self, spec: EpisodeSpec) -> Episode:
        """The episode, with all data from the simulator."""
        states = [time_step.state for time_step in self.time_steps]
        contacts = [
            (index, *pair)
            for index, time_step in enumerate(self.time_steps)
            for pair in time_step.contacts
        ]
        actions = [time_step.action for time_step in self.time_steps]
        return Episode(
            spec=spec,
            video=np.stack([time_step.frame for time_step in self.time_steps]),
            actions=np.stack([*actions[1:], np.zeros_like(actions[0])]),
            states={name: np.stack([state[name] for state in states]) for name in states[0]},
            masks=np.stack([time_step.mask for time_step in self.time_steps]),
            contacts=np.array(contacts, np.int32).reshape(-1, 3),
            factors=self.time_steps[0].factors,
            ood_label=self.time_steps[0].ood_label,
        )


def save(recording: PlayedEpisode, card: EnvironmentCard, out: Path) -> tuple[Path, int, Path]:
    """Add a recording of at least two frames to the dataset of its world below `out`.

    Returns:
        The folder of the dataset, the episode's number in its training split, and the video with
        simulator, model and difference side by side.

    Raises:
        DataError: the folder holds another dataset, is in use or cannot be written.
    """
    height, width = card.frame_size
    folder = inside(out, f"{card.name}-{height}x{width}")
    with _writing, writing(folder):  # one tab at a time
        folder.mkdir(parents=True, exist_ok=True)
        with held(folder):
            index = _append(recording, card, folder)
    video = out / f"{folder.name}-{index:06d}.mp4"
    true = as_clip(np.stack([time_step.frame for time_step in recording.time_steps]))
    predicted = as_clip(np.stack(recording.model_frames))
    with writing(video):
        write_mp4(video, join_panels(panels(true, predicted)), card.fps, magnification(height))
    return folder, index, video


def _append(recording: PlayedEpisode, card: EnvironmentCard, folder: Path) -> int:
    """Write one shard per episode, so that existing shards do not change."""
    requires = catalog().component("environment", card.name).requires
    new = DatasetCard(
        environment=replace(card, horizon=MAX_FRAMES),
        splits={"train": 1},
        seed=0,
        options={"size": list(card.frame_size)},
        factors={},
        shard_episodes=1,
        versions=package_versions(requires),
        source={"kind": "play", "name": card.name, "notes": [NOTE]},
    )
    existing = DatasetCard.read(folder) if (folder / CARD).exists() else None
    count = existing.splits["train"] if existing else 0
    if existing and (differences := existing.differences(replace(new, splits=existing.splits))):
        raise other_dataset(folder, differences)
    shards = folder / "train"
    shards.mkdir(exist_ok=True)
    episode = recording.episode(new.spec("train", count))
    check_episode(episode, new.environment)
    record = write_shard(shards / shard_name(count), [episode], card.fps, new.versions)
    manifest = Manifest(shards)
    manifest.add(record)
    manifest.finish()
    updated = replace(
        new,
        splits={"train": count + 1},
        actions={"train": action_statistics(manifest.ordered())},
        checksums={"train": manifest.checksum()},
    )
    updated.write(folder)
    write_readme(folder, updated)
    return count
