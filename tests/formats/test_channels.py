"""Channels of arrays that are not colours: four moments in grey, or opacity."""

import gymnasium
import h5py
import numpy as np
import pytest
import zarr
from click.testing import CliRunner
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_formats.frames import ImageFrames
from acwm_formats.hdf5 import HDF5
from acwm_formats.minari_datasets import Minari
from acwm_formats.zarr_replay import ZarrReplay

COUNT, SIDE = 12, 84
RNG = np.random.default_rng(0)
SCREENS = RNG.integers(0, 256, (COUNT, SIDE, SIDE), dtype=np.uint8)
RGBA = RNG.integers(0, 256, (COUNT, SIDE, SIDE, 4), dtype=np.uint8)
ROWS = RNG.uniform(-1, 1, (COUNT, 2)).astype(np.float32)


def stacked(depth=4, *, first=False, screens=SCREENS, apart=1):
    """Stacks ``[T, depth, H, W]`` of the last screens; the first is repeated at the start."""
    places = np.arange(len(screens))[:, None] - apart * np.arange(depth)
    return screens[np.maximum(places if first else places[:, ::-1], 0)]


def hdf5(folder, frames, **options):
    with h5py.File(folder / "a.h5", "w") as file:
        file["run/seen"], file["run/action"] = frames, ROWS
    return HDF5().read(folder / "a.h5", video="seen", actions="action", rate=10, **options)


def replay(folder, frames, **options):
    group = zarr.open_group(str(folder / "a.zarr"), mode="w", zarr_format=2)
    group.create_array("data/seen", data=frames)
    group.create_array("data/action", data=ROWS)
    group.create_array("meta/episode_ends", data=np.array([COUNT]))
    return ZarrReplay().read(folder / "a.zarr", rate=10, **options)


def minari(folder, frames, *, less=1, **options):
    (place := folder.absolute() / "a" / "data").mkdir(parents=True)
    low, high = (0, 255) if frames.dtype == np.uint8 else (0.0, 1.0)
    space = gymnasium.spaces.Box(low, high, frames.shape[1:], frames.dtype.type)
    acts = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    storage = MinariStorage.new(
        place, observation_space=space, action_space=acts, jpeg_encoding=False
    )
    taken = ROWS[: COUNT - less]
    ends = [False] * len(taken)
    storage.update_episodes(
        [
            EpisodeBuffer(
                observations=frames,
                actions=taken,
                rewards=[0.0] * len(taken),
                terminations=ends,
                truncations=ends,
            )
        ]
    )
    storage.update_metadata({"dataset_id": "stack/a-v0", "minari_version": "0.5.0"})
    return Minari().read(place.parent, rate=10.0, **options)


WRITERS = {"hdf5": hdf5, "zarr": replay, "minari": minari}
each_format = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


def shown(recorded):
    (frames,) = recorded.splits[0].cameras.values()
    return np.stack([*frames.read(range(COUNT))])


@each_format
@pytest.mark.parametrize("depth", [3, 4])
@pytest.mark.parametrize("first", [False, True], ids=["newest last", "newest first"])
@pytest.mark.parametrize("last_axis", [False, True], ids=["channels first", "channels last"])
def test_a_stack_shows_its_newest_moment(tmp_path, write, depth, first, last_axis):
    frames = stacked(depth, first=first)
    recorded = write(tmp_path, np.moveaxis(frames, 1, 3) if last_axis else frames)
    np.testing.assert_array_equal(shown(recorded), np.repeat(SCREENS[..., None], 3, 3))
    assert any(f"stacks of {depth} grey frames" in note for note in recorded.notes)


@each_format
def test_four_channels_are_refused_unless_they_are_named(tmp_path, write):
    with pytest.raises(DataError, match="--channels rgba, newest-last or newest-first"):
        shown(write(tmp_path, RGBA))


@pytest.mark.parametrize("write", [hdf5, replay])
def test_named_channels_are_believed(tmp_path, write):
    wanted = (RGBA[..., :3].astype(np.uint16) * RGBA[..., 3:] + 127) // 255
    np.testing.assert_array_equal(shown(write(tmp_path, RGBA, channels="rgba")), wanted)
    newest = shown(write(tmp_path / "..", RGBA, channels="newest-first"))
    np.testing.assert_array_equal(newest, np.repeat(RGBA[..., :1], 3, 3))


def frames_of(images, **options):
    return ImageFrames(images, np.arange(len(images)) / 10, **options)


def test_a_stack_of_floats_is_no_depth():
    screens = SCREENS.astype(np.float32) / 255
    frames = frames_of(stacked(screens=screens))
    assert not frames.depth
    np.testing.assert_array_equal(next(frames.read([5]))[..., 0], SCREENS[5])


def test_a_stack_in_which_little_moves_is_one():
    screens = np.zeros_like(SCREENS)
    screens[9:, 3, 3] = 200
    assert frames_of(stacked(screens=screens)).colour_order == "newest-last"
    assert frames_of(stacked(3, screens=screens)).colour_order == "newest-last"


@pytest.mark.parametrize("apart", [2, 3, 4])
@pytest.mark.parametrize("depth", [3, 4])
@pytest.mark.parametrize("first", [False, True])
def test_a_stack_whose_moments_are_some_frames_apart(apart, depth, first):
    frames = frames_of(stacked(depth, first=first, apart=apart))
    assert frames.colour_order == ("newest-first" if first else "newest-last")
    np.testing.assert_array_equal(next(frames.read([9]))[..., 0], SCREENS[9])


def test_colours_are_no_stack():
    still = np.repeat(RGBA[:1, ..., :3], COUNT, 0)
    opaque = np.concatenate([RGBA[..., :3], np.full_like(RGBA[..., :1], 255)], 3)
    grey = np.repeat(SCREENS[..., None], 3, 3)
    for images in (still, RGBA[..., :3], grey, grey[:1]):
        frames = frames_of(images)
        assert frames.colour_order == "rgb"
        np.testing.assert_array_equal(np.stack([*frames.read([0])])[0], images[0])
    assert frames_of(opaque).colour_order == "rgba"
    with pytest.raises(DataError, match="four channels"):
        frames_of(np.repeat(RGBA[:1], COUNT, 0)).colour_order  # noqa: B018


def test_the_command_names_channels(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for run in "abc":
            file[f"{run}/seen"], file[f"{run}/action"] = RGBA, ROWS
    words = ["data", "import", "hdf5", str(tmp_path / "a.h5"), "--video", "seen", "--rate", "10"]
    words += ["--actions", "action", "--out", str(tmp_path / "out"), "--workers", "0"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert "--channels" in done.stderr
    done = CliRunner().invoke(main, [*words, "--channels", "newest-last"])
    assert done.exit_code == 0, done.output
    assert "newest-last" in done.output


def test_an_observation_per_step_is_told(tmp_path):
    recorded = minari(tmp_path, np.repeat(SCREENS[..., None], 3, 3), less=0)
    assert any("as many observations as steps" in note for note in recorded.splits[0].notes)
    recorded = minari(tmp_path / "b", np.repeat(SCREENS[..., None], 3, 3))
    assert not recorded.splits[0].notes
