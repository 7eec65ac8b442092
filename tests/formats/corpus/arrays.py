"""Files of arrays: HDF5 in several layouts, Zarr and Minari, written by their own libraries."""

import io
import json

import gymnasium
import h5py
import numpy as np
import zarr
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from PIL import Image

from tests.formats.corpus.pictures import depth, picture


def _coloured(convert):
    return lambda numbers, size: np.stack([convert(picture(number, size)) for number in numbers])


PIXELS = {
    "rgb": _coloured(lambda image: image),
    "grey": _coloured(lambda image: np.asarray(Image.fromarray(image).convert("L"))[..., None]),
    "alpha": _coloured(lambda image: np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])),
    "first": _coloured(lambda image: np.ascontiguousarray(image.transpose(2, 0, 1))),
    "float": _coloured(lambda image: (image / 255).astype(np.float32)),
    "float255": _coloured(lambda image: image.astype(np.float32)),
    "half": _coloured(lambda image: (image / 255).astype(np.float16)),
    "16 bits": _coloured(lambda image: image.astype(np.uint16) * 257),
    "12 bits": _coloured(lambda image: image.astype(np.uint16) * 16),
    "signed": _coloured(lambda image: (image / 127.5 - 1).astype(np.float32)),
    "depth": lambda numbers, size: np.stack([depth(n, size)[..., None] for n in numbers]),
    "metres": lambda numbers, size: np.stack(
        [depth(n, size)[..., None].astype(np.float32) / 1000 for n in numbers]
    ),
}
"""Frames ``[T, …]`` of numbers, by how a pixel is stored."""


def images(case, episode):
    """The frames of an episode of the case."""
    return PIXELS[case.pixels](episode.numbers, case.size)


def jpegs(case, episode):
    """Each frame as the bytes of a JPEG, padded to one length, as ALOHA compresses."""
    files = []
    for number in episode.numbers:
        file = io.BytesIO()
        Image.fromarray(picture(number, case.size)).save(file, "JPEG", quality=92)
        files.append(file.getvalue())
    longest = max(map(len, files))
    return np.stack([np.frombuffer(f.ljust(longest, b"\0"), np.uint8) for f in files])


def robomimic(folder, case):
    """`data/demo_i` in one file, with the environment's settings as JSON."""
    path = folder / "demo.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        settings = {"control_freq": float(case.rate), "controller_configs": {"control_delta": True}}
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": settings})
        for place, episode in enumerate(case.episodes):
            demo = data.create_group(f"demo_{place}")
            demo["obs/agentview_image"] = images(case, episode)
            demo["obs/robot0_eef_pos"] = np.zeros((len(episode.numbers), 3))
            demo["actions"] = np.asarray(episode.rows)
            demo["rewards"] = np.zeros(len(episode.numbers))
    return path, {}


def libero(folder, case):
    """As robomimic, with other names and the task in attributes."""
    path, _ = robomimic(folder, case)
    with h5py.File(path, "a") as file:
        file["data"].attrs["problem_info"] = json.dumps({"language_instruction": "put it down"})
        for demo in file["data"].values():
            demo.move("obs/agentview_image", "obs/agentview_rgb")
    return path, {}


def aloha(folder, case, compressed=False):
    """A file per episode; their rate, 50, is not in the files."""
    for place, episode in enumerate(case.episodes):
        with h5py.File(folder / f"episode_{place}.hdf5", "w") as file:
            file.attrs["sim"] = True
            shown = jpegs(case, episode) if compressed else images(case, episode)
            file["observations/images/cam_high"] = shown
            file["observations/qpos"] = np.zeros((len(episode.numbers), 14))
            file["action"] = np.asarray(episode.rows)
    return folder, {} if case.rate == 50 else {"rate": float(case.rate)}


def aloha_compressed(folder, case):
    """With a padded JPEG per frame."""
    return aloha(folder, case, compressed=True)


def mapped(folder, case):
    """A layout of somebody's own."""
    path = folder / "mine.h5"
    with h5py.File(path, "w") as file:
        for place, episode in enumerate(case.episodes):
            file[f"runs/{place}/obs/front"] = images(case, episode)
            file[f"runs/{place}/cmd"] = np.asarray(episode.rows)
    return path, {"video": "obs/front", "actions": "cmd", "rate": float(case.rate)}


def replay(folder, case, version=2):
    """A replay buffer of diffusion policy."""
    path = folder / "replay.zarr"
    group = zarr.open_group(str(path), mode="w", zarr_format=version)
    frames = np.concatenate([images(case, episode) for episode in case.episodes])
    rows = np.concatenate([np.asarray(episode.rows) for episode in case.episodes])
    group.create_array("data/img", data=frames, chunks=(4, *frames.shape[1:]))
    group.create_array("data/action", data=rows)
    group.create_array("data/state", data=np.zeros((len(rows), 5), np.float32))
    ends = np.cumsum([len(episode.numbers) for episode in case.episodes])
    group.create_array("meta/episode_ends", data=ends)
    return path, {"rate": float(case.rate)}


def replay_3(folder, case):
    """The same in version 3 of Zarr."""
    return replay(folder, case, version=3)


def minari(folder, case):
    """A dataset of Minari: one action fewer than observations."""
    path = folder.absolute() / "corpus" / "data"  # the library doubles relative paths
    path.mkdir(parents=True)
    first = images(case, case.episodes[0])
    space = gymnasium.spaces.Box(0, 255, first.shape[1:], np.uint8)
    rows = np.asarray(case.episodes[0].rows)
    acts = gymnasium.spaces.Box(-100, 100, rows.shape[1:], rows.dtype.type)
    storage = MinariStorage.new(
        path, observation_space=gymnasium.spaces.Dict({"camera": space}), action_space=acts
    )
    for episode in case.episodes:
        taken = np.asarray(episode.rows)[:-1]
        ends = [False] * len(taken)
        storage.update_episodes(
            [
                EpisodeBuffer(
                    observations={"camera": images(case, episode)},
                    actions=taken,
                    rewards=[0.0] * len(taken),
                    terminations=ends,
                    truncations=ends,
                )
            ]
        )
    storage.update_metadata({"dataset_id": "corpus/case-v0", "minari_version": "0.5.0"})
    return path.parent, {"rate": float(case.rate)}
