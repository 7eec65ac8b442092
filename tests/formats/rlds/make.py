"""Writes the datasets of this folder with TensorFlow Datasets, and what it reads in them.

    python -m venv /tmp/tfds && /tmp/tfds/bin/pip install tensorflow-cpu tensorflow-datasets
    /tmp/tfds/bin/python tests/formats/rlds/make.py

They were made with tensorflow-datasets 4.9.10 and tensorflow 2.21.0. `expected.npz` of a dataset
has what TensorFlow Datasets itself decodes: `SPLIT/EPISODE/PATH`, in the order in which it reads.
"""

import shutil
import tempfile
from pathlib import Path
from typing import ClassVar

import numpy as np
import tensorflow_datasets as tfds
from etils import epath

HERE = Path(__file__).parent
SIZE = (32, 48)

FLAGS = {name: np.bool_ for name in ("is_first", "is_last", "is_terminal")}


def flags(step, length):
    return {"is_first": step == 0, "is_last": step == length - 1, "is_terminal": step == length - 1}


def picture(rng, step):
    """A smooth picture, so that JPEG keeps it, with a square that moves."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    frame = np.stack([rows * 4, columns * 3, np.full(SIZE, 60)], -1).astype(np.uint8)
    frame[4 + step : 12 + step, 8:16] = rng.integers(150, 250, 3)
    return frame


class Steps(tfds.core.GeneratorBasedBuilder, skip_registration=True):
    VERSION = tfds.core.Version("1.0.0")
    pkg_dir_path = epath.Path(HERE)

    def _split_generators(self, dl_manager):
        return {split: self._generate_examples(split) for split in self.SPLITS}

    def _generate_examples(self, split):
        for number, length in enumerate(self.SPLITS[split]):
            rng = np.random.default_rng([number, len(split)])
            steps = [{**self.step(rng, k), **flags(k, length)} for k in range(length)]
            yield f"{split}{number}", {"steps": steps, **self.episode(number)}

    def episode(self, number):
        return {}


class SquarePng(Steps):
    """A vector as the action, PNG, an instruction, two shards."""

    SPLITS: ClassVar = {"train": [5, 6, 7, 4], "test": [5, 3]}

    def _info(self):
        step = {
            "observation": {
                "image": tfds.features.Image(shape=(*SIZE, 3), encoding_format="png"),
                "state": tfds.features.Tensor(shape=(4,), dtype=np.float32),
            },
            "action": tfds.features.Tensor(shape=(2,), dtype=np.float32),
            "reward": np.float32,
            "discount": np.float32,
            "language_instruction": tfds.features.Text(),
            "language_embedding": tfds.features.Tensor(shape=(8,), dtype=np.float32),
            **FLAGS,
        }
        features = tfds.features.FeaturesDict({"steps": tfds.features.Dataset(step)})
        return self.dataset_info_from_configs(features=features)

    def step(self, rng, k):
        return {
            "observation": {
                "image": picture(rng, k),
                "state": rng.normal(size=4).astype(np.float32),
            },
            "action": rng.normal(size=2).astype(np.float32),
            "reward": float(k),
            "discount": 1.0,
            "language_instruction": "push the square",
            "language_embedding": np.ones(8, np.float32),
        }


class ArmsJpeg(Steps):
    """Nested observations, two cameras in JPEG and depth in PNG, actions as a dict, metadata."""

    SPLITS: ClassVar = {"train": [4, 5], "val": [6]}

    def _info(self):
        image = tfds.features.Image(shape=(*SIZE, 3), encoding_format="jpeg")
        depth = tfds.features.Image(shape=(*SIZE, 1), dtype=np.uint16, encoding_format="png")
        step = {
            "observation": {
                "front": image,
                "wrist": {"rgb": image, "depth": depth},
                "natural_language_instruction": tfds.features.Text(),
                "gripper": np.float32,
                "pose": tfds.features.Tensor(shape=(2, 3), dtype=np.float64),
            },
            "action": {
                "world_vector": tfds.features.Tensor(shape=(3,), dtype=np.float32),
                "gripper_closedness": tfds.features.Tensor(shape=(1,), dtype=np.float32),
                "terminate": tfds.features.Tensor(shape=(3,), dtype=np.int32),
            },
            "reward": tfds.features.Scalar(dtype=np.float32),
            **FLAGS,
        }
        metadata = {"file_path": tfds.features.Text(), "success": np.bool_, "seed": np.int64}
        features = {"steps": tfds.features.Dataset(step), "episode_metadata": metadata}
        return self.dataset_info_from_configs(features=tfds.features.FeaturesDict(features))

    def step(self, rng, k):
        depth = rng.integers(500, 2000, (*SIZE, 1)).astype(np.uint16)
        return {
            "observation": {
                "front": picture(rng, k),
                "wrist": {"rgb": picture(rng, k + 3), "depth": depth},
                "natural_language_instruction": "open the drawer",
                "gripper": 0.25 * k,
                "pose": rng.normal(size=(2, 3)),
            },
            "action": {
                "world_vector": rng.normal(size=3).astype(np.float32),
                "gripper_closedness": np.array([k % 2], np.float32),
                "terminate": np.array([0, 1, -k], np.int32),
            },
            "reward": 0.5,
        }

    def episode(self, number):
        facts = {"file_path": f"/data/{number}.h5", "success": number == 0, "seed": 2**40 + number}
        return {"episode_metadata": facts}


class Tensors(Steps):
    """Frames as tensors: plain, as bytes and by zlib; lists of various lengths; doubles."""

    SPLITS: ClassVar = {"train": [5, 3]}

    def _info(self):
        def frames(encoding):
            shape = (*SIZE, 3)
            return tfds.features.Tensor(shape=shape, dtype=np.uint8, encoding=encoding)

        step = {
            "observation": {
                "bytes": frames("bytes"),
                "packed": frames("zlib"),
                "plain": frames("none"),
                "touched": tfds.features.Sequence(np.int32),
                "counts": tfds.features.Tensor(shape=(2,), dtype=np.int64),
            },
            "action": np.float64,
            **FLAGS,
        }
        features = tfds.features.FeaturesDict({"steps": tfds.features.Dataset(step)})
        return self.dataset_info_from_configs(features=features)

    def step(self, rng, k):
        frame = picture(rng, k)
        return {
            "observation": {
                "bytes": frame,
                "packed": 255 - frame,
                "plain": frame[::-1],
                "touched": list(range(k % 3)),
                "counts": np.array([k, -(2**40)]),
            },
            "action": 0.1 * k,
        }


def flat(values, prefix=""):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def expected(builder):
    """What TensorFlow Datasets reads."""
    arrays = {}
    for split in builder.SPLITS:
        config = tfds.ReadConfig(interleave_cycle_length=1)
        episodes = builder.as_dataset(split=split, read_config=config, shuffle_files=False)
        for number, episode in enumerate(tfds.as_numpy(episodes)):
            steps = [dict(flat(step)) for step in episode.pop("steps")]
            rows = {name: [step[name] for step in steps] for name in steps[0]}
            for name, values in rows.items():
                if len({np.shape(value) for value in values}) == 1:
                    arrays[f"{split}/{number}/{name}"] = np.array(values)
            arrays |= {f"{split}/{number}/{n}": np.array(v) for n, v in flat(episode)}
    kept = {n: a.astype("S") if a.dtype == object else a for n, a in arrays.items()}
    return kept


def main():
    for kind in (SquarePng, ArmsJpeg, Tensors):
        with tempfile.TemporaryDirectory() as folder:
            builder = kind(data_dir=folder)
            shards = 2 if kind is SquarePng else 1
            config = tfds.download.DownloadConfig(num_shards=shards)
            builder.download_and_prepare(download_config=config)
            place = HERE / builder.name
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(Path(folder, builder.name), place)
            np.savez_compressed(place / "expected.npz", **expected(builder))


if __name__ == "__main__":
    main()
