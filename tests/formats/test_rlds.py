"""RLDS: what TensorFlow Datasets wrote is read as it reads it; what is damaged is refused.

`rlds/make.py` made the files and what is expected of them.
"""

import functools
import json
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.recordings import import_dataset

pytest.importorskip("google_crc32c", reason="needs the extra rlds")

from acwm_formats import rlds_example as written
from acwm_formats.rlds import RLDS
from acwm_formats.tfrecords import masked_crc, record_places

HERE = Path(__file__).parent / "rlds"


@functools.lru_cache
def expected(name):
    """What TensorFlow Datasets read, by path."""
    with np.load(HERE / name / "expected.npz") as file:
        return dict(file)


def read(name, **options):
    return RLDS().read(HERE / name, rate=10.0, **options)


def titled(dataset):
    """The recordings by split and number."""
    recordings = [dataset.splits[k] for k in range(len(dataset.splits))]
    return {f"{r.facts['split']}/{r.name.rpartition(' ')[2]}": r for r in recordings}


def shown(recording, camera, depth_range=None):
    frames = recording.cameras[camera]
    return np.stack([*frames.read(range(len(frames.times)), depth_range)])


EPISODES = {
    "square_png": {"train": [5, 6, 7, 4], "test": [5, 3]},
    "arms_jpeg": {"train": [4, 5], "val": [6]},
    "tensors": {"train": [5, 3]},
}


@pytest.mark.parametrize("name", EPISODES)
def test_all_episodes_are_there_in_order(name):
    dataset, lengths = read(name), EPISODES[name]
    found = titled(dataset)
    assert len(found) == len(dataset.splits) == sum(map(len, lengths.values()))
    for split, wanted in lengths.items():
        assert sorted(
            r.length or len(r.actions.values) for k, r in found.items() if k.startswith(split)
        ) == sorted(wanted)
    tests = (dataset.tests or {}).get("ind_test", [])
    assert [dataset.splits[k].facts["split"] in ("test", "val") for k in tests] == [True] * sum(
        len(wanted) for split, wanted in lengths.items() if split != "train"
    )


def test_png_and_vectors_are_those_of_tensorflow_datasets():
    dataset, truth = read("square_png"), expected("square_png")
    for key, recording in titled(dataset).items():
        assert np.array_equal(shown(recording, "image"), truth[f"{key}/observation/image"])
        assert np.array_equal(recording.actions.values, truth[f"{key}/action"])
        assert {*recording.states} == {"state"}
        assert np.array_equal(recording.states["state"].values, truth[f"{key}/observation/state"])
        assert recording.facts["language_instruction"] == "push the square"
        assert recording.facts["rewards"] == truth[f"{key}/reward"].tolist()
    assert "steps/language_embedding" in " ".join(dataset.notes)


def test_nested_observations_and_a_dict_of_actions_are_those_of_tensorflow_datasets():
    dataset, truth = read("arms_jpeg"), expected("arms_jpeg")
    assert dataset.actions.names == (
        *("gripper_closedness", "terminate_0", "terminate_1", "terminate_2"),
        *("world_vector_0", "world_vector_1", "world_vector_2"),
    )
    for key, recording in titled(dataset).items():
        assert {*recording.cameras} == {"front", "wrist/rgb", "wrist/depth"}
        for camera in ("front", "wrist/rgb"):
            # TensorFlow's JPEG decoder rounds in another way than Pillow's.
            apart = shown(recording, camera).astype(int) - truth[f"{key}/observation/{camera}"]
            assert np.abs(apart).max() <= 24  # at the edges of colours
            assert np.abs(apart).mean() < 2
        near, far = 0.5, 2.0
        metres = truth[f"{key}/observation/wrist/depth"] / 1000
        wanted = np.rint(255 * np.clip((far - metres) / (far - near), 0, 1))
        apart = shown(recording, "wrist/depth", (near, far)).astype(int) - wanted
        assert np.abs(apart).max() <= 1
        names = ("gripper_closedness", "terminate", "world_vector")
        actions = np.concatenate([truth[f"{key}/action/{n}"] for n in names], 1)
        assert np.array_equal(recording.actions.values, actions)
        pose = recording.states["pose"].values
        assert np.array_equal(pose, truth[f"{key}/observation/pose"])
        assert recording.facts["natural_language_instruction"] == "open the drawer"
        assert recording.facts["episode_metadata/seed"] == truth[f"{key}/episode_metadata/seed"]
        assert recording.facts["episode_metadata/success"] in (True, False)
        path = truth[f"{key}/episode_metadata/file_path"].item().decode()
        assert recording.facts["episode_metadata/file_path"] == path


def test_frames_in_tensors_of_every_encoding_are_those_of_tensorflow_datasets():
    dataset, truth = read("tensors"), expected("tensors")
    for key, recording in titled(dataset).items():
        assert {*recording.cameras} == {"bytes", "packed", "plain"}
        for camera in recording.cameras:
            assert np.array_equal(shown(recording, camera), truth[f"{key}/observation/{camera}"])
        assert np.array_equal(recording.states["counts"].values, truth[f"{key}/observation/counts"])
        assert np.array_equal(recording.actions.values[:, 0], truth[f"{key}/action"])
    assert "steps/observation/touched" in " ".join(dataset.notes)


def test_an_import_becomes_a_dataset(tmp_path):
    import_dataset(read("square_png"), tmp_path / "out", progress=False)
    data, truth = EpisodeDataset(tmp_path / "out", "train"), expected("square_png")
    assert DatasetCard.read(tmp_path / "out").splits == {"train": 4, "ind_test": 2}
    for number, length in enumerate(EPISODES["square_png"]["train"]):
        key = next(
            k for k in (f"train/{n}" for n in range(4)) if len(truth[f"{k}/action"]) == length
        )
        episode = next(data[k] for k in range(4) if len(data[k].video) == length)
        assert np.array_equal(episode.actions[:-1], truth[f"{key}/action"][:-1])
        assert episode.video.shape[1:] == truth[f"{key}/observation/image"].shape[1:]
        del number


def test_cameras_actions_and_states_can_be_chosen():
    dataset = read("arms_jpeg", video="wrist/rgb", actions="action/world_vector", states="gripper")
    recording = dataset.splits[0]
    assert {*recording.cameras} == {"wrist/rgb"}
    assert recording.actions.values.shape == (len(recording.actions.values), 3)
    assert {*recording.states} == {"gripper"}
    with pytest.raises(DataError, match=r"no images 'wrist/rbg'; did you mean 'wrist/rgb'\?"):
        read("arms_jpeg", video="wrist/rbg")


@pytest.fixture
def copied(tmp_path):
    """A dataset that may be spoilt."""
    shutil.copytree(HERE / "square_png" / "1.0.0", tmp_path / "square" / "1.0.0")
    return tmp_path / "square" / "1.0.0"


def opened(folder):
    """Read everything."""
    dataset = RLDS().read(folder, rate=10.0)
    for recording in titled(dataset).values():
        for camera in recording.cameras:
            shown(recording, camera)
    return dataset


def first_shard(folder):
    return folder / "square_png-train.tfrecord-00000-of-00002"


@pytest.mark.parametrize("cut", [1, 5, 100, 2000])
def test_a_shard_that_is_cut_off_is_refused(copied, cut):
    shard = first_shard(copied)
    shard.write_bytes(shard.read_bytes()[:-cut])
    with pytest.raises(DataError, match=r"is cut off in record \d"):
        opened(copied)


def test_a_shard_that_lost_whole_records_is_refused(copied):
    shard = first_shard(copied)
    place = record_places(shard)[-1]
    shard.write_bytes(shard.read_bytes()[: place.start - 12])
    with pytest.raises(DataError, match=r"has 1 episodes, but dataset_info\.json says 2"):
        opened(copied)


def test_every_flipped_bit_is_noticed(copied):
    shard, rng = first_shard(copied), np.random.default_rng(0)
    sound = shard.read_bytes()
    for place in rng.choice(len(sound), 60, replace=False):
        spoilt = bytearray(sound)
        spoilt[place] ^= 1 << int(rng.integers(8))
        shard.write_bytes(spoilt)
        with pytest.raises(DataError, match=r"checksum|cut off"):
            opened(copied)


def test_a_record_that_claims_terabytes_is_refused(copied):
    shard = first_shard(copied)
    length = (2**42).to_bytes(8, "little")
    shard.write_bytes(length + struct.pack("<I", masked_crc(length)) + b"x" * 50)
    with pytest.raises(DataError, match="cut off in record 0"):
        opened(copied)


def test_missing_shards_and_splits_are_told(copied):
    first_shard(copied).unlink()
    for path in copied.glob("*-test*"):
        path.unlink()
    notes = " ".join(opened(copied).notes)
    assert "1 of 2 files of the split train are not there" in notes
    assert "Splits that are not there: test" in notes


def test_files_of_another_kind_and_several_versions_are_refused(copied):
    info = copied / "dataset_info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "fileFormat": "riegeli"}))
    with pytest.raises(DataError, match="holds riegeli files: only tfrecord is read"):
        opened(copied)
    shutil.copytree(HERE / "square_png" / "1.0.0", copied.parent / "2.0.0")
    with pytest.raises(DataError, match="has several versions: name"):
        opened(copied.parent)


FLAG = written.tensor((), "bool")
FRAMES = {"observation": {"image": written.tensor((8, 8, 3), "uint8", "zlib")}}


def made(folder, lists, **features):
    step = {"action": written.tensor((2,), "float32"), **FRAMES, **features}
    packed = [zlib.compress(bytes(192))] * 3
    usual = {"steps/observation/image": packed, "steps/action": np.zeros((3, 2))}
    record = written.example_of({**usual, **lists})
    written.write_dataset(folder / "made" / "1.0.0", step, [record])
    return folder / "made"


def test_actions_that_do_not_fit_the_steps_are_refused(tmp_path):
    folder = made(tmp_path, {"steps/action": np.zeros((2, 2))})
    with pytest.raises(DataError, match=r"steps/action has 4 numbers for 3 steps of \[2\]"):
        opened(folder)


def test_frames_that_unpack_to_more_than_they_claim_are_refused(tmp_path):
    bomb = zlib.compress(bytes(200_000_000))
    folder = made(tmp_path, {"steps/observation/image": [bomb] * 3})
    with pytest.raises(DataError, match="a value of other than 192 bytes"):
        opened(folder)


def test_two_episodes_in_one_are_refused_and_a_cut_one_is_told(tmp_path):
    first = {"steps/is_first": np.array([1, 0, 1]), "steps/is_last": np.array([0, 0, 1])}
    folder = made(tmp_path / "a", first, is_first=FLAG, is_last=FLAG)
    with pytest.raises(DataError, match="another episode begins within it, in step 2"):
        opened(folder)
    folder = made(tmp_path / "b", {"steps/is_last": np.zeros(3, int)}, is_last=FLAG)
    (recording,) = titled(opened(folder)).values()
    assert "may have been cut off" in recording.notes[0]


def test_cameras_of_different_lengths_are_refused(tmp_path):
    pair = {"a": FRAMES["observation"]["image"], "b": FRAMES["observation"]["image"]}
    packed = zlib.compress(bytes(192))
    lists = {"steps/observation/a": [packed] * 3, "steps/observation/b": [packed] * 2}
    folder = made(tmp_path, lists, observation=pair)
    with pytest.raises(DataError, match="3 of a, 2 of b, not an image for each step"):
        opened(folder)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "cannot be read"),
        ("[]", "describes no episodes"),
        ('{"type": "x", "content": "{}"}', "before 4.6"),
        ('{"featuresDict": {"features": {"image": {"text": {}}}}}', "describes no episodes"),
        ("[" * 100_000, "cannot be read"),
    ],
)
def test_descriptions_of_something_else_are_refused(copied, content, said):
    (copied / "features.json").write_text(content)
    with pytest.raises(DataError, match=said):
        opened(copied)


def test_a_value_that_claims_gigapixels_is_refused(tmp_path):
    huge = {"observation": {"image": written.tensor((10**6, 10**6, 3), "uint8", "zlib")}}
    folder = made(tmp_path, {}, **huge)
    with pytest.raises(DataError, match="claims values of"):
        opened(folder)
