"""Exports of a dataset at 30000/1001 frames/s: every reader finds the exact times."""

import json
from fractions import Fraction

import av
import h5py
import numpy as np
import pyarrow.parquet
import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.env.environment import ActionSpec
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.format import export_dataset
from acwm_formats.hdf5 import HDF5
from acwm_formats.lerobot import LeRobot
from acwm_formats.published import Published
from acwm_formats.recordings import import_dataset
from tests.formats.conftest import episodes_of
from tests.formats.corpus.pictures import number_in, picture

NTSC = Fraction(30000, 1001)
LENGTHS = {"train": (7, 9), "ind_test": (8,)}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three episodes of numbered pictures."""
    folder = tmp_path_factory.mktemp("ntsc") / "data"
    action = ActionSpec(("push",), ("m",), (0.0,), (10.0,), "delta")
    splits = {
        split: [
            Recording(np.stack([picture(k) for k in range(n)]), np.arange(n - 1.0)[:, None])
            for n in lengths
        ]
        for split, lengths in LENGTHS.items()
    }
    write_dataset(folder, splits, name="push_cube", action=action, fps=NTSC, progress=False)
    return folder


@pytest.fixture(scope="module", params=[LeRobot, HDF5, Published], ids=lambda f: f.__name__)
def exported(request, data, tmp_path_factory):
    """A format, and the folder that it wrote."""
    out = tmp_path_factory.mktemp("exported") / request.param.__name__
    return request.param, export_dataset(data, out, request.param(), progress=False)


def test_videos_have_exact_times(exported):
    target, folder = exported
    if target is HDF5:
        with h5py.File(folder / "train.hdf5") as file:
            fps = json.loads(file.attrs["card"])["environment"]["fps"]
        assert fps == pytest.approx(float(NTSC), abs=1e-12)
        return
    found = 0
    for path in sorted(folder.rglob("*.mp4")):
        with av.open(str(path)) as file:
            assert file.streams.video[0].average_rate == NTSC
            times = [Fraction(f.pts) * f.time_base for f in file.decode(video=0)]
        assert times == [k / NTSC for k in range(len(times))]
        found += len(times)
    assert found == sum(sum(lengths) for lengths in LENGTHS.values())


def test_rows_of_lerobot_have_exact_times(exported):
    target, folder = exported
    if target is not LeRobot:
        pytest.skip("only LeRobot has times in rows")
    (path,) = (folder / "data").rglob("*.parquet")
    table = pyarrow.parquet.read_table(path)
    numbers = np.array(table.column("frame_index"))
    np.testing.assert_allclose(
        np.array(table.column("timestamp")), numbers / float(NTSC), atol=1e-6
    )
    assert json.loads((folder / "meta/info.json").read_text())["fps"] == pytest.approx(float(NTSC))


def test_it_comes_back(exported, data, tmp_path):
    target, folder = exported
    found = target().read(folder)
    recorded = next(iter(found.values())) if isinstance(found, dict) else found
    card = import_dataset(recorded, tmp_path / "back", workers=0, progress=False)
    before = DatasetCard.read(data)
    assert card.environment.fps == before.environment.fps
    if target is not Published:  # whose layout has actions in [-1, 1] without names
        assert card.environment.action == before.environment.action
    assert card.splits == before.splits
    for ours, theirs in zip(episodes_of(data), episodes_of(tmp_path / "back"), strict=True):
        taken = ours.actions / 5 - 1 if target is Published else ours.actions
        np.testing.assert_allclose(taken[:-1], theirs.actions[:-1], atol=1e-5)
        assert [*map(number_in, ours.video)] == [*map(number_in, theirs.video)]
        if target is HDF5:
            np.testing.assert_array_equal(ours.video, theirs.video)
