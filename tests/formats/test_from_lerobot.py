"""LeRobot datasets come in: those of the library itself, of version 2, and none that mislead."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.check import check_dataset
from acwm_formats.lerobot import LeRobot
from acwm_formats.reading import ImportOptions, common_reading, divided
from tests.formats import release
from tests.formats.conftest import episodes_of, imported, psnr

REFERENCE = Path(__file__).parents[1] / "reference" / "lerobot"
LENGTHS = (9, 7, 8, 6)


def load(root, out, **options):
    return imported(LeRobot().read(root), out, **options)


def lengths(folder):
    """Number of frames of all episodes of a data folder."""
    return [len(episode.video) for episode in episodes_of(folder)]


def reference_video(episode):
    frames = np.full((LENGTHS[episode], 48, 64, 3), 40 + 30 * episode, np.uint8)
    for t, frame in enumerate(frames):
        frame[8:40, 4 * t : 4 * t + 16] = (220, 200 - 20 * episode, 60)
    return frames


@pytest.fixture
def root(tmp_path):
    """A copy of the library's dataset to spoil."""
    return shutil.copytree(REFERENCE / "video", tmp_path / "toy")


def change_info(root, **values):
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def change_places(root, **columns):
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    for name, values in columns.items():
        name = name.replace("__", "/")
        kept = table.drop_columns([name])
        table = kept if values is None else kept.append_column(name, pa.array(values))
    pq.write_table(table, path)


@pytest.mark.parametrize("kind", ["video", "image"])
def test_what_the_library_wrote_comes_in(kind, tmp_path):
    card = load(REFERENCE / kind, tmp_path / "data", test_episodes=0)
    assert card.splits == {"train": 4}
    assert (card.environment.fps, card.environment.frame_size) == (10, (48, 64))
    assert card.environment.action.names == ("shoulder", "elbow")
    assert (card.environment.action.low, card.environment.action.high) == (
        (0.25, -3.5),
        (3.25, 3.5),  # the last row of an episode leads to no frame
    )
    assert "toy arm" in card.environment.summary
    for number, episode in enumerate(episodes_of(tmp_path / "data")):
        length = LENGTHS[number]
        assert len(episode.video) == length
        truth = reference_video(number)
        assert psnr(episode.video, truth) > (99 if kind == "image" else 27)  # AV1 at CRF 30
        expected = [(number + 0.25, t - 3.5) for t in range(length - 1)]
        np.testing.assert_array_equal(episode.actions, [*expected, (0, 0)])
        states = [(number, t, number * t) for t in range(length)]
        np.testing.assert_array_equal(episode.states["observation.state"], states)
    assert [f for f in check_dataset(tmp_path / "data") if f.problem] == []


def parts(root, test_episodes=None):
    """The numbers of the episodes of each split."""
    found = divided(LeRobot().read(root), test_episodes)
    return {split: list(numbers) for split, (_, numbers) in found.items()}


def test_splits_are_the_datasets_own_or_the_last_episodes(root):
    assert parts(root) == {"train": [0, 1], "ind_test": [2, 3]}
    assert parts(root, 1) == {"train": [0, 1, 2], "ind_test": [3]}
    assert parts(root, 0) == {"train": [0, 1, 2, 3]}
    with pytest.raises(DataError, match="4 of 4 episodes cannot be set aside"):
        parts(root, 4)
    change_info(root, splits={"train": "0:1", "test": "1:3", "val": "3:4"})
    assert parts(root) == {"train": [0, 3], "ind_test": [1, 2]}


def test_frames_shrink_and_the_name_can_be_given(root, tmp_path):
    card = load(root, tmp_path / "data", size=(24, 32), environment="my_arm")
    assert card.environment.name == "my_arm"
    truth = reference_video(0).reshape(9, 24, 2, 32, 2, 3).mean((2, 4))
    assert psnr(EpisodeDataset(tmp_path / "data", "train")[0].video, truth) > 27


def test_a_video_that_ends_early_is_told_with_both_numbers(root, tmp_path):
    shortened = np.concatenate([reference_video(e) for e in range(4)])[:-2]
    release.video(root / "videos/observation.images.top/chunk-000/file-000.mp4", shortened)
    with pytest.raises(DataError, match=r"episode 3: it claims 6 frames, but has 4"):
        load(root, tmp_path / "data")
    card = load(root, tmp_path / "skipped", on_defect="skip")
    assert lengths(tmp_path / "skipped") == [9, 7, 8]
    assert "6 frames, but has 4" in card.source["skipped"][0]
    load(root, tmp_path / "trimmed", on_defect="trim")
    assert lengths(tmp_path / "trimmed") == [9, 7, 8, 4]


def test_names_in_any_form(root):
    info = json.loads((root / "meta/info.json").read_text())
    action = info["features"]["action"]
    for names, found in (
        (["a", "b"], ("a", "b")),
        ([["a", "b"]], ("a", "b")),
        ({"a": 0, "b": 1}, ("a", "b")),
        (None, ("action_0", "action_1")),
        (["only"], ("action_0", "action_1")),
    ):
        action["names"] = names
        change_info(root, features=info["features"])
        read = LeRobot().read(root)
        first = read.splits[0]
        assert common_reading(read, first, ImportOptions()).action.names == found


def version_2(root, lengths=(9, 7, 8)):
    """A dataset of version 2.1, written by hand."""
    camera = "observation.images.top"
    features = {
        camera: {"dtype": "video", "shape": [48, 64, 3], "names": None},
        "action": {"dtype": "float32", "shape": [2], "names": ["shoulder", "elbow"]},
    }
    (root / "meta").mkdir(parents=True)
    info = {
        "codebase_version": "v2.1",
        "fps": 10,
        "chunks_size": 2,
        "features": features,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/"
        "episode_{episode_index:06d}.mp4",
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    lines = [json.dumps({"episode_index": e, "length": n}) for e, n in enumerate(lengths)]
    (root / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
    for episode, length in enumerate(lengths):
        chunk = f"chunk-{episode // 2:03d}"
        video = root / "videos" / chunk / camera / f"episode_{episode:06d}.mp4"
        rows = root / "data" / chunk / f"episode_{episode:06d}.parquet"
        for path in (video, rows):
            path.parent.mkdir(parents=True, exist_ok=True)
        release.video(video, reference_video(episode))
        frames = list(range(length))
        table = {
            "action": [[episode + 0.25, t - 3.5] for t in frames],
            "frame_index": frames,
            "episode_index": [episode] * length,
        }
        pq.write_table(pa.table(table), rows)


def test_version_2_comes_in_too(tmp_path):
    version_2(tmp_path / "old")
    load(tmp_path / "old", tmp_path / "data", test_episodes=0)
    for number, episode in enumerate(episodes_of(tmp_path / "data")):
        assert psnr(episode.video, reference_video(number)) > 30
        assert episode.actions[2].tolist() == [number + 0.25, -1.5]


def longer(path, episode, frames):
    """A video that goes on in grey after the last row."""
    more = np.full((frames, 48, 64, 3), 128, np.uint8)
    release.video(path, np.concatenate([reference_video(episode), more]))


@pytest.mark.parametrize("frames", [1, 2])
def test_frames_after_the_last_row_are_left_out(tmp_path, frames):
    root = tmp_path / "old"
    version_2(root)
    for number, video in enumerate(sorted(root.glob("videos/*/*/*.mp4"))):
        longer(video, number, frames)
    card = load(root, tmp_path / "data", test_episodes=0)
    assert lengths(tmp_path / "data") == [9, 7, 8]
    for number, episode in enumerate(episodes_of(tmp_path / "data")):
        assert psnr(episode.video, reference_video(number)) > 30
        expected = [(number + 0.25, t - 3.5) for t in range(len(episode.video) - 1)]
        np.testing.assert_array_equal(episode.actions, [*expected, (0, 0)])
    (note,) = [note for note in card.source["notes"] if "no row" in note]
    assert note.startswith(f"3 recordings, e.g. episode 0: its last {frames} frame")


def test_many_frames_more_than_rows_are_asked_about(tmp_path):
    root = tmp_path / "old"
    version_2(root)
    longer(root / "videos/chunk-000/observation.images.top/episode_000001.mp4", 1, 5)
    with pytest.raises(DataError, match=r"episode 1: it claims 7 frames, but has 12"):
        load(root, tmp_path / "data")
    load(root, tmp_path / "data", test_episodes=0, on_defect="trim")
    assert lengths(tmp_path / "data") == [9, 7, 8]


def spoil(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda r: change_info(r, codebase_version="v4.0"), r"version v4\.0; 2\.0, 2\.1 and 3\.0"),
        (lambda r: change_info(r, features={}), "no camera"),
        (lambda r: change_info(r, features=[1]), "no features"),
        (lambda r: change_info(r, fps=0), "no features or no fps"),
        (lambda r: change_info(r, data_path="../../etc/passwd"), "leads out of "),
        (lambda r: change_info(r, video_path="/etc/{video_key}"), "leads out of "),
        (lambda r: change_info(r, data_path="{chunk_index.__class__}"), "cannot be read"),
        (lambda r: change_info(r, data_path="{secret}"), "does not say where its episodes are"),
        (lambda r: change_places(r, length=None), "does not say where its episodes are"),
        (lambda r: change_places(r, episode_index=[0, 1, 1, 2]), "episode 1 twice"),
        (lambda r: change_places(r, data__file_index=[0, 0, 0, 7]), r"file-007\.parquet cannot"),
        (lambda r: spoil(r / "meta/episodes/chunk-000/file-000.parquet"), "cannot be read"),
        (lambda r: spoil(r / "data/chunk-000/file-000.parquet"), "cannot be read"),
        (lambda r: (r / "meta/info.json").write_text("{" * 9999), r"info\.json cannot be read"),
        (lambda r: (r / "meta/info.json").unlink(), "is not a LeRobot dataset"),
        (lambda r: shutil.rmtree(r / "meta/episodes"), "not a complete LeRobot dataset"),
        (lambda r: (r / "meta/acwm.json").write_text('{"name": 3}'), "is not a card"),
    ],
)
def test_what_misleads_is_refused(root, change, problem, tmp_path):
    change(root)
    with pytest.raises(DataError, match=problem):
        load(root, tmp_path / "data")


def test_a_damaged_video_and_a_wrong_camera_are_named(root, tmp_path):
    with pytest.raises(DataError, match=r"did you mean 'observation\.images\.top'"):
        load(root, tmp_path / "data", cameras=("observation.images.to",))
    with pytest.raises(DataError, match="cannot be enlarged"):
        load(root, tmp_path / "data", size=128)
    video = root / "videos/observation.images.top/chunk-000/file-000.mp4"
    content = video.read_bytes()
    video.write_bytes(b"text")
    with pytest.raises(DataError, match=r"file-000\.mp4 is not an MP4"):
        load(root, tmp_path / "data")
    video.write_bytes(content)
    assert load(root, tmp_path / "data").splits["train"] == 2


def test_actions_that_are_none_are_refused(root, tmp_path):
    path = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    place = table.schema.get_field_index("action")
    for values, problem in (
        (pa.array(["left"] * len(table)), "not numbers"),
        (pa.array([[float("nan")] * 2] * len(table)), "not finite"),
        (pa.array([[1.0] * (1 + i % 2) for i in range(len(table))]), "different shapes"),
    ):
        pq.write_table(table.set_column(place, "action", values), path)
        with pytest.raises(DataError, match=problem):
            load(root, tmp_path / "data")
    pq.write_table(table.drop_columns(["action"]), path)
    with pytest.raises(DataError, match="cannot be read"):
        load(root, tmp_path / "data")
