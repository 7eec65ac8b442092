"""Datasets of strangers: nothing in them is run, and no name in them leads out."""

import io
import shutil

import numpy as np
import pytest
from conftest import checksums
from forging import forge, npy, problems, replaced, sign, zipped

from acwm_core.data.card import MANIFEST
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.video import encode_masks, encode_video
from acwm_core.errors import DataError
from tests.plugins import Attack

SHARD = "train/shard-00000.tar"
KEY = "train-000001"


@pytest.fixture
def data(square_data, tmp_path):
    return shutil.copytree(square_data, tmp_path / "data")


def refused(folder, what=SHARD):
    """The one problem there is; the check wrote nothing and found the rest sound."""
    before = checksums(folder)
    found = problems(folder, replays=0)
    assert checksums(folder) == before
    assert list(found) == [what]
    assert "\n" not in found[what]
    return found[what]


@pytest.mark.parametrize("member", ["actions.npy", "contacts.npy", "states.npz"])
def test_pickles_are_never_loaded(data, tmp_path, member):
    mark = tmp_path / "mark"
    attack = npy(np.array([Attack(mark)], object))
    if member == "states.npz":
        attack = zipped({"position.npy": attack})
    forge(data, replaced(f"{KEY}.{member}", attack))
    assert "it holds object, not plain numbers" in refused(data)
    assert not mark.exists()
    np.load(io.BytesIO(npy(np.array([Attack(mark)], object))), allow_pickle=True)
    assert mark.exists()  # the attack is real


def test_states_under_names_that_lead_out_are_refused(data):
    states = zipped({"../position.npy": npy(np.zeros((21, 2)))})
    for content in (states, b"PK\x05\x06" + bytes(18)):
        forge(data, replaced(f"{KEY}.states.npz", content))
        assert "the state fields are" in refused(data)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"shard": "../../../etc/passwd"}, "not the name of a shard"),
        ({"shard": "/etc/passwd"}, "not the name of a shard"),
        ({"shard": "shard-00000.tar/../../x"}, "not the name of a shard"),
        ({"shard": "shard-00000.tar\n"}, "not the name of a shard"),
        ({"lengths": [10**12]}, "cannot hold episodes of 1,000,000,000,000 frames"),
        ({"lengths": [30, -1]}, "cannot hold episodes of 29 frames"),
    ],
)
def test_manifests_that_mislead_are_refused(data, change, problem):
    sign(data, **change)
    assert problem in refused(data, f"train/{MANIFEST}")


@pytest.mark.parametrize("member", ["video.mkv", "mask.mkv"])
@pytest.mark.parametrize(
    ("shape", "problem"),
    [((2, 256, 256), "its frames are 256×256, not 32×32"), ((400, 32, 32), "more than 22 frames")],
)
def test_videos_that_unpack_to_more_than_the_card_says(data, member, shape, problem):
    encode = encode_video if member == "video.mkv" else encode_masks
    frames = np.zeros((*shape, 3) if member == "video.mkv" else shape, np.uint8)
    forge(data, replaced(f"{KEY}.{member}", encode(frames)))
    assert problem in refused(data)
    with pytest.raises(DataError, match=problem):
        EpisodeDataset(data, "train")[1]
