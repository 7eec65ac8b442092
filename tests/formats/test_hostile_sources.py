"""Recordings of strangers: what does harm is refused in one sentence; nothing outside is read."""

import json
import shutil
import subprocess
import zlib

import gymnasium
import h5py
import numpy as np
import pyarrow
import pyarrow.dataset
import pyarrow.ipc
import pytest
import zarr
from click.testing import CliRunner
from mcap.writer import CompressionType, Writer
from minari.dataset.minari_storage import MinariStorage
from numcodecs import Blosc, Zstd

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_formats.arrow_files import check_arrow
from acwm_formats.format import detected_format
from acwm_formats.hdf5 import HDF5
from acwm_formats.minari_datasets import Minari
from tests.formats import hostile, release
from tests.formats.corpus import arrays, files, logs
from tests.formats.corpus.cases import Case, three
from tests.formats.corpus.clips import Clip

PLAIN = Case("plain", three())
PICTURES = Case("pictures", three(), clip=Clip(suffix="png"), column="time")


def published(folder, _):
    release.environment(folder / "push_block")
    return folder / "push_block", {}


def pictures(folder, _):
    return files.videos(folder, PICTURES)


FORMATS = {
    "videos": (files.videos, ["take_9.mp4", "take_9.csv"]),
    "pictures": (pictures, ["take_9/frame_1.png", "take_9.csv"]),
    "lerobot": (
        files.lerobot,
        [
            "meta/info.json",
            "meta/episodes.jsonl",
            "data/chunk-000/episode_000001.parquet",
            "videos/chunk-000/observation.images.top/episode_000001.mp4",
        ],
    ),
    "hdf5": (arrays.aloha, ["episode_1.hdf5"]),
    "zarr": (arrays.replay, ["data/img/1.0.0.0", "data/action/.zarray", "meta/episode_ends/0"]),
    "minari": (arrays.minari, ["data/main_data.hdf5", "data/metadata.json"]),
    "mcap": (logs.in_json, None),
    "acwm-phys": (published, ["ind_train/metadata.pt", "ind_train/episode_1.mp4"]),
}


def name_of(form):
    return "videos" if form == "pictures" else form


def source(folder, form, place=None):
    """Recordings in a format, one of their files, and the options that the import needs."""
    root = folder / "source"
    root.mkdir()
    write, names = FORMATS[form]
    path, options = write(root, PLAIN)
    names = names or [sorted(each.name for each in path.iterdir())[1]]
    return path, path / names[place or 0], options


def run(form, path, out, options, *words):
    asked = [f"--{name}={value}" for name, value in options.items()]
    command = ["data", "import", *([form] if form else []), str(path), "--out", str(out), *asked]
    return CliRunner().invoke(main, [*command, "--workers", "0", *words])


def refused(done):
    """The sentence by which an import ends, or its list of defects."""
    assert done.exit_code == 2, done.output
    assert isinstance(done.exception, SystemExit)
    assert "Traceback" not in done.stderr
    return done.stderr


PLACES = [
    (form, place) for form, (_, names) in FORMATS.items() for place in range(len(names or [0]))
]


@pytest.mark.parametrize(("form", "place"), PLACES)
def test_links_lead_nowhere_else(tmp_path, form, place):
    path, spoilt, options = source(tmp_path, form, place)
    (tmp_path / "elsewhere").symlink_to(path)
    assert run(name_of(form), tmp_path / "elsewhere", tmp_path / "data", options).exit_code == 0
    hostile.link(spoilt)
    said = refused(run(name_of(form), path, tmp_path / "again", options))
    assert f"{spoilt.name} is a link that leads out of" in said
    assert "--follow-links" in said
    done = run(name_of(form), path, tmp_path / "again", options, "--follow-links")
    assert done.exit_code == 0, done.output
    cards = [DatasetCard.read(tmp_path / name) for name in ("data", "again")]
    assert cards[0].splits == cards[1].splits
    assert "--follow-links" in cards[1].source["command"]


@pytest.mark.parametrize(("form", "place"), PLACES)
@pytest.mark.parametrize("spoil", [hostile.pipe, hostile.pointer])
def test_pipes_and_pointers_are_named(tmp_path, form, place, spoil):
    path, spoilt, options = source(tmp_path, form, place)
    spoil(spoilt)
    problem = "is not a file" if spoil is hostile.pipe else "is a pointer of Git LFS"
    assert f"{spoilt.name} {problem}" in refused(
        run(name_of(form), path, tmp_path / "data", options)
    )


@pytest.mark.parametrize("form", [form for form in FORMATS if form != "pictures"])
def test_a_source_of_pointers_is_named_without_a_format(tmp_path, form):
    path, _, options = source(tmp_path, form)
    for each in path.rglob("*"):
        if each.is_file():
            hostile.pointer(each)
    assert "is a pointer of Git LFS" in refused(run(None, path, tmp_path / "data", options))


@pytest.mark.parametrize("form", ["videos", "pictures", "lerobot", "hdf5", "mcap", "minari"])
def test_what_macos_adds_is_no_recording(tmp_path, form):
    path, _, options = source(tmp_path, form)
    for each in list(path.rglob("*")):
        if each.is_file():
            each.with_name(f"._{each.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    assert detected_format(path) == name_of(form)
    done = run(name_of(form), path, tmp_path / "data", options)
    assert done.exit_code == 0, done.output
    assert sum(DatasetCard.read(tmp_path / "data").splits.values()) == 3


@pytest.mark.parametrize("name", hostile.TABLES)
def test_tables_that_do_harm(tmp_path, name):
    (tmp_path / "source").mkdir()
    files.videos(tmp_path / "source", PLAIN)
    (tmp_path / "source/take_9.csv").unlink()
    table = tmp_path / "source" / f"take_9.{name.split()[0].partition('.')[2]}"
    content = hostile.TABLES[name]
    table.write_bytes(content if isinstance(content, bytes) else content())
    assert "take_9" in refused(run("videos", tmp_path / "source", tmp_path / "data", {}))


def test_links_behind_a_url_of_files(tmp_path):
    path, spoilt, options = source(tmp_path, "videos")
    hostile.link(spoilt)
    said = refused(run(None, f"file://{path}", tmp_path / "data", options))
    assert f"{spoilt.name} is a link that leads out of" in said


def test_a_picture_is_no_program(tmp_path, monkeypatch):
    path, spoilt, options = source(tmp_path, "pictures")
    spoilt.write_bytes(hostile.POSTSCRIPT)
    monkeypatch.setattr(subprocess, "Popen", None)
    said = refused(run("videos", path, tmp_path / "data", options))
    assert "frame_1.png is not a picture" in said


@pytest.mark.parametrize("stored", ["hdf5", "arrow", "parquet"])
def test_a_picture_in_minari_is_no_program(tmp_path, monkeypatch, stored):
    path = minari(tmp_path, stored)
    if stored == "hdf5":
        with h5py.File(path / "data/main_data.hdf5", "a") as file:
            frames = file["episode_0/observations/camera"]
            frames[2] = np.frombuffer(hostile.POSTSCRIPT, np.uint8)
    else:
        (place,) = (path / "data/0").glob(f"*.{stored}")
        dataset = pyarrow.dataset.dataset(str(place), format=stored)
        table = dataset.to_table()
        column = table.column("observations").combine_chunks()
        frames = pyarrow.array([hostile.POSTSCRIPT, *column.field("camera").to_pylist()[1:]])
        parts = [frames, column.field("pose")]
        column = pyarrow.StructArray.from_arrays(parts, ["camera", "pose"])
        table = table.set_column(table.column_names.index("observations"), "observations", column)
        pyarrow.dataset.write_dataset(
            table, place.parent, format=stored, existing_data_behavior="delete_matching"
        )
    monkeypatch.setattr(subprocess, "Popen", None)
    said = refused(run("minari", path, tmp_path / "out", {"rate": 10}))
    assert "episode 0: an image is not a picture" in said


def minari(folder, stored, jpeg=True):
    """A dataset of Minari in one of its ways to store arrays, by the library."""
    place = folder / "source" / "data"
    place.mkdir(parents=True)
    rng = np.random.default_rng(0)
    space = gymnasium.spaces.Dict(
        {
            "camera": gymnasium.spaces.Box(0, 255, (64, 48, 3), np.uint8),
            "pose": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64),
        }
    )
    storage = MinariStorage.new(
        place,
        observation_space=space,
        action_space=gymnasium.spaces.Discrete(3),
        data_format=stored,
        jpeg_encoding=jpeg,
    )
    for length in (5, 6, 7):
        storage.update_episodes(
            [
                arrays.EpisodeBuffer(
                    observations={
                        "camera": rng.integers(0, 256, (length + 1, 64, 48, 3), np.uint8),
                        "pose": rng.normal(size=(length + 1, 2)),
                    },
                    actions=rng.integers(0, 3, length),
                    rewards=[0.0] * length,
                    terminations=[False] * length,
                    truncations=[False] * length,
                )
            ]
        )
    storage.update_metadata({"dataset_id": "noise/case-v0", "minari_version": "0.5.0"})
    return place.parent


@pytest.mark.parametrize("jpeg", [True, False])
@pytest.mark.parametrize("stored", ["hdf5", "arrow", "parquet"])
def test_minari_is_read_as_its_library_reads_it(tmp_path, stored, jpeg):
    path = minari(tmp_path, stored, jpeg)
    found = Minari().read(path, rate=10.0).splits
    library = MinariStorage.read(path / "data")
    for index in range(len(found)):
        (episode,) = library.get_episodes([index])
        recording = found[index]
        frames = recording.cameras["camera"]
        shown = np.stack([*frames.read(range(len(frames.times)))])
        np.testing.assert_array_equal(shown, episode["observations"]["camera"])
        pose = recording.states["pose"].values
        np.testing.assert_array_equal(pose, episode["observations"]["pose"])
        np.testing.assert_array_equal(recording.actions.values.argmax(1), episode["actions"])


@pytest.mark.parametrize("stored", ["hdf5", "arrow"])
def test_minari_that_claims_more_episodes_than_it_has(tmp_path, stored):
    path = minari(tmp_path, stored)
    file = path / "data/metadata.json"
    metadata = json.loads(file.read_text())
    for claim in (10**9, 4, 2, -1):
        file.write_text(json.dumps({**metadata, "total_episodes": claim}))
        said = refused(run("minari", path, tmp_path / "out", {"rate": 10}))
        assert f"claims {claim:,} episodes, and 3 are there" in said
    file.write_bytes(b'{"minari_version": "1", "x": ' + hostile.DEEP + b"}")
    assert "nested too deeply" in refused(run("minari", path, tmp_path / "out", {"rate": 10}))


@pytest.mark.parametrize("stored", ["hdf5", "arrow"])
def test_minari_from_which_an_episode_was_removed(tmp_path, stored):
    path = minari(tmp_path, stored)
    if stored == "hdf5":
        with h5py.File(path / "data/main_data.hdf5", "a") as file:
            del file["episode_1"]
    else:
        shutil.rmtree(path / "data/1")
    file = path / "data/metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "total_episodes": 2}))
    found = Minari().read(path, rate=10.0).splits
    assert [(found[i].name, len(found[i].actions.values)) for i in range(len(found))] == [
        ("episode 0", 5),
        ("episode 2", 7),
    ]


@pytest.mark.parametrize("name", ["task", "qpos"])
def test_hdf5_keeps_nothing_in_another_file(tmp_path, name):
    """Data of an array may lie in any file, whose content would become a fact or a state."""
    path, spoilt, options = source(tmp_path, "hdf5")
    (tmp_path / "secret").write_bytes(b"secret of the user" * 9)
    with h5py.File(spoilt, "a") as file:
        place = file["observations"] if name == "qpos" else file
        shape, kind = ((1,), "S9") if name == "task" else ((9, 2), "f4")
        if name in place:
            del place[name]
        place.create_dataset(name, shape, kind, external=[(str(tmp_path / "secret"), 0, 160)])
    said = refused(run("hdf5", path, tmp_path / "data", options))
    assert f"{name} to {tmp_path / 'secret'}, which is not in {path}" in said


CLAIMS = {
    "actions": lambda file: file.create_dataset("action", (10**12, 2), "f8", chunks=(64, 2)),
    "rows of actions": lambda file: file.create_dataset(
        "action", (8, 10**12), "f8", chunks=(8, 64)
    ),
    "frames": lambda file: file.create_dataset(
        "observations/images/cam_high", (10**15, 8, 8, 3), "u1", chunks=(1, 8, 8, 3)
    ),
    "pixels": lambda file: file.create_dataset(
        "observations/images/cam_high", (8, 10**7, 10**7, 3), "u1", chunks=(1, 8, 8, 3)
    ),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_hdf5_that_claims_more_than_it_stores(tmp_path, claim):
    path, spoilt, options = source(tmp_path, "hdf5")
    with h5py.File(spoilt, "a") as file:
        del file["observations/images/cam_high" if claim in ("frames", "pixels") else "action"]
        CLAIMS[claim](file)
    assert spoilt.name in refused(run("hdf5", path, tmp_path / "data", options))


@pytest.mark.parametrize("twice", [False, True])
def test_chunks_of_hdf5_that_unpack_to_more_than_they_hold(tmp_path, monkeypatch, twice):
    monkeypatch.setattr("acwm_formats.hdf5_chunks.LARGE", 2**22)  # so that a test need not be slow
    rng = np.random.default_rng(0)
    path = tmp_path / "mine.h5"
    options = {"video": "front", "actions": "cmd", "rate": 10.0}
    with h5py.File(path, "w") as file:
        frames = rng.integers(0, 256, (8, 64, 64, 3), np.uint8)  # 12 KB, which do not shrink
        stored = file.create_dataset(
            "runs/0/front", data=frames, chunks=(1, 64, 64, 3), compression=1
        )
        file["runs/0/cmd"] = np.zeros((8, 2))
        shown = HDF5().read(path, **options).splits[0].cameras["front"]
        np.testing.assert_array_equal(np.stack([*shown.read(range(8))]), frames)
        if twice:
            del file["runs/0/front"]
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_chunk((1, 64, 64, 3))
            for _ in range(2):
                plist.set_deflate(9)
            space, kind = h5py.h5s.create_simple((8, 64, 64, 3)), h5py.h5t.NATIVE_UINT8
            h5py.h5d.create(file["runs/0"].id, b"front", kind, space, plist)
        else:
            stored.id.write_direct_chunk((3, 0, 0, 0), zlib.compress(bytes(5 * 2**20), 9))
    said = refused(run("hdf5", path, tmp_path / "data", options))
    assert (
        "is compressed 2 times" if twice else "unpacks to more than the 12,288 it holds"
    ) in said


@pytest.mark.parametrize("codec", [Blosc("zstd"), Zstd(9)])
def test_chunks_of_zarr_that_unpack_to_gigabytes(tmp_path, codec):
    path, spoilt, options = source(tmp_path, "zarr")
    about = json.loads((spoilt.parent / ".zarray").read_text())
    about["compressor"] = codec.get_config()
    (spoilt.parent / ".zarray").write_text(json.dumps(about))
    bomb = codec.encode(bytes(2**28 + 2**20))
    for chunk in spoilt.parent.glob("[0-9]*"):
        chunk.write_bytes(bomb)
    assert "claim to hold 269," in refused(run("zarr", path, tmp_path / "data", options))


def test_buffers_of_arrow_that_unpack_to_gigabytes(tmp_path):
    table = pyarrow.table({"x": np.zeros(2**12), "y": pyarrow.array(["a", "b"] * 2**11)})
    path, lies = tmp_path / "x.arrow", 2**33
    for codec in ("zstd", "lz4", None):
        options = pyarrow.ipc.IpcWriteOptions(compression=codec)
        with pyarrow.ipc.new_file(path, table.schema, options=options) as writer:
            writer.write_table(table)
        check_arrow(path)
        if codec:
            claim = (table["x"].nbytes).to_bytes(8, "little")
            path.write_bytes(path.read_bytes().replace(claim, lies.to_bytes(8, "little")))
            with pytest.raises(ValueError, match="claim to hold 8,589"):
                check_arrow(path)


@pytest.mark.parametrize(
    ("name", "shape", "chunks"),
    [
        ("meta/episode_ends", (10**12,), (10,)),
        ("data/action", (10**13, 2), (10, 2)),
        ("data/action", (27, 10**12), (1, 10)),
        ("data/img", (27, 10**6, 10**6, 3), (1, 8, 8, 3)),
        ("data/img", (27, 64, 48, 3), (10**9, 64, 48, 3)),
    ],
)
def test_zarr_that_claims_more_than_it_stores(tmp_path, name, shape, chunks):
    path, _, options = source(tmp_path, "zarr")
    dtype = "i8" if name.startswith("meta") else "u1"
    group = zarr.open_group(str(path), mode="a", zarr_format=2)
    group.create_array(name, shape=shape, chunks=chunks, dtype=dtype, overwrite=True)
    assert refused(run("zarr", path, tmp_path / "data", options)).count("\n") == 1


@pytest.mark.parametrize("size", [(65535, 65535, 1), (9000, 9000, 2), (8000, 8000, 600)])
def test_gifs_that_unpack_for_minutes(tmp_path, size):
    (tmp_path / "source").mkdir()
    files.videos(tmp_path / "source", PLAIN)
    (tmp_path / "source/take_9.mp4").unlink()
    (tmp_path / "source/take_9.gif").write_bytes(hostile.gif(*size))
    said = refused(run("videos", tmp_path / "source", tmp_path / "data", {}))
    assert "take_9.gif" in said
    assert "pixels" in said or size == (65535, 65535, 1)  # which FFmpeg refuses


@pytest.mark.parametrize("first", ["0", "-1e300", "1e-300", "1700000000000000000"])
def test_times_that_are_far_off(tmp_path, first):
    """The frames between would fill the memory."""
    path, _, options = source(tmp_path, "pictures")
    table = path / "take_9.csv"
    lines = table.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for place, row in enumerate(rows):
        row[0] = first if not place else str(1.8e9 + place / 10)
    table.write_text("\n".join([lines[0], *map(",".join, rows)]))
    assert "take_9" in refused(run("videos", path, tmp_path / "data", options))


@pytest.mark.parametrize("size", [8, -1, -50])
def test_a_log_that_is_cut_off_says_so(tmp_path, size):
    path, spoilt, options = source(tmp_path, "mcap")
    spoilt.write_bytes(spoilt.read_bytes()[:size])
    assert "it is cut off: repair it" in refused(run("mcap", path, tmp_path / "data", options))


@pytest.mark.parametrize("lies", [False, True])
def test_chunks_of_a_log_that_unpack_to_gigabytes(tmp_path, lies):
    path, spoilt, options = source(tmp_path, "mcap")
    with spoilt.open("wb") as file:
        writer = Writer(file, chunk_size=2**30, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("/zeros", "json", 0)
        for _ in range(5):
            writer.add_message(channel, 0, bytes(2**26), 0)
        writer.finish()
    if lies:  # the header of the chunk, not that of what is in it
        data = spoilt.read_bytes()
        place = data.index(b"\x06", 60) + 9 + 16
        spoilt.write_bytes(data[:place] + bytes(8) + data[place + 8 :])
    assert "claim to hold 335," in refused(run("mcap", path, tmp_path / "data", options))


@pytest.mark.parametrize("name", ["meta/info.json", "meta/episodes.jsonl", "meta/acwm.json"])
def test_deep_json_of_lerobot(tmp_path, name):
    path, _, options = source(tmp_path, "lerobot")
    (path / name).write_bytes(b'{"features": ' + hostile.DEEP + b"}")
    said = refused(run("lerobot", path, tmp_path / "data", options))
    assert said.count("\n") == 1
    assert "nested too deeply" in said


@pytest.mark.parametrize(
    "change",
    [
        {"fps": 1e300},
        {"fps": 1e-300},
        {"chunks_size": 0},
        {"chunks_size": None},
        {"video_path": "{video_key:09d}"},
        {"video_path": "../../{video_key}.mp4"},
        {"data_path": "/etc/passwd"},
        {"data_path": "a\0b"},
        {"data_path": None},
        {"features": {}},
        {"splits": "all"},
        {"codebase_version": ["v2.1"]},
    ],
    ids=str,
)
def test_forged_facts_of_lerobot(tmp_path, change):
    path, _, options = source(tmp_path, "lerobot")
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps({**info, **change}))
    refused(run("lerobot", path, tmp_path / "data", options))


def test_a_deep_card_in_hdf5(tmp_path):
    _, spoilt, _ = source(tmp_path, "hdf5")
    with h5py.File(spoilt, "a") as file:
        file.attrs["format"] = "acwm"
        file.attrs["card"] = np.void(b'{"environment": ' + hostile.DEEP[::20] + b"}")
        file.create_group("episode_0")
    refused(run("hdf5", spoilt, tmp_path / "data", {}))
    refused(run(None, spoilt, tmp_path / "data", {}))
