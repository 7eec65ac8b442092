"""LeRobot datasets whose files disagree: each frame keeps its own action, or it is told."""

import json
import shutil
from fractions import Fraction

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.check import check_dataset
from acwm_formats.lerobot import LeRobot
from tests.formats.conftest import imported
from tests.formats.corpus.clips import Clip, write_clip
from tests.formats.corpus.pictures import number_in

NTSC = Fraction(30000, 1001)
TOP, DEPTH = "observation.images.top", "observation.images.depth"
GREY = Clip("ffv1", "gray16le", "mkv")


def write(root, numbers, times, rows=None, *, rate=30, fps=30, clip=None, copies=1):
    """A dataset of version 2.1 whose videos show `numbers` at `times`.

    `rows` are the numbers of frames; the action of row k is (k, 1). `clip` is a second camera,
    which comes first.
    """
    rows = list(range(len(numbers))) if rows is None else list(rows)
    cameras = {DEPTH: clip, TOP: Clip()} if clip else {TOP: Clip()}
    template = "{video_key}/episode_{episode_index:03d}.mp4"
    features = {n: {"dtype": "video", "shape": [48, 64, 3], "names": None} for n in cameras}
    info = {
        "codebase_version": "v2.1",
        "fps": fps,
        "chunks_size": 1000,
        "features": features | {"action": {"dtype": "float32", "shape": [2], "names": None}},
        "data_path": "data/{episode_index:03d}.parquet",
        "video_path": template,
    }
    for folder in ("meta", "data", *cameras):
        (root / folder).mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    lines = [json.dumps({"episode_index": e, "length": len(rows)}) for e in range(copies)]
    (root / "meta/episodes.jsonl").write_text("\n".join(lines))
    for episode in range(copies):
        for name, each in cameras.items():
            path = root / template.format(video_key=name, episode_index=episode)
            if episode:
                shutil.copy(root / template.format(video_key=name, episode_index=0), path)
                continue
            made = path.with_suffix(f".{each.suffix}")
            write_clip(made, numbers, times, rate, each)
            made.replace(path)
        table = {
            "action": pa.array([[k, 1.0] for k in rows], pa.list_(pa.float32())),
            "frame_index": rows,
            "episode_index": [episode] * len(rows),
        }
        pq.write_table(pa.table(table), root / f"data/{episode:03d}.parquet")
    return root


def read(root, out, **options):
    card = imported(LeRobot().read(root), out, shard_episodes=32, **options)
    assert [found for found in check_dataset(out) if found.problem] == []
    return card


def shown(out, index=0):
    """Numbers of the frames of an episode, and first dimension of its actions."""
    episode = EpisodeDataset(out, "train")[index]
    return [number_in(frame) for frame in episode.video], episode.actions[:-1, 0].tolist()


def steps(count, rate=30, first=0):
    return [Fraction(k + first) / Fraction(rate) for k in range(count)]


def test_a_video_of_30000_1001_frames_per_second_is_whole(tmp_path):
    numbers = [k % 128 for k in range(1200)]
    root = write(tmp_path / "in", numbers, steps(1200, NTSC), rate=NTSC)
    card = read(root, tmp_path / "out")
    assert shown(tmp_path / "out") == (numbers, list(range(1199)))
    assert card.environment.fps == pytest.approx(float(NTSC), rel=1e-9)
    assert len(card.source["notes"]) == 2  # about units and bounds: nothing was filled or cut


def test_a_dropped_frame_is_filled_and_told(tmp_path):
    left = [k for k in range(30) if k != 7]
    root = write(tmp_path / "in", left, [Fraction(k, 30) for k in left], range(30))
    card = read(root, tmp_path / "out")
    assert shown(tmp_path / "out") == ([*range(7), 6, *range(8, 30)], list(range(29)))
    assert any("1 missing of camera" in note for note in card.source["notes"])
    with pytest.raises(DataError, match=r"episode 0: .*missing for .*--max-gap"):
        read(root, tmp_path / "other", max_gap=0)


def test_a_video_that_starts_two_frames_late_keeps_its_frames(tmp_path):
    root = write(tmp_path / "in", range(12), steps(12, first=2))
    read(root, tmp_path / "out")
    assert shown(tmp_path / "out") == (list(range(12)), list(range(11)))


def test_rows_with_a_gap_stay_with_their_frames(tmp_path):
    rows = [*range(4), *range(6, 12)]
    root = write(tmp_path / "in", range(12), steps(12), rows)
    with pytest.raises(DataError, match="it claims 10 frames, but has 12"):
        read(root, tmp_path / "out")
    lines = json.dumps({"episode_index": 0, "length": 12})
    (root / "meta/episodes.jsonl").write_text(lines)
    read(root, tmp_path / "out")
    numbers, actions = shown(tmp_path / "out")
    assert numbers == list(range(12))
    assert [actions[k] for k in rows[:-1]] == rows[:-1]


def test_a_colour_camera_is_chosen_and_depth_needs_a_range(tmp_path):
    root = write(tmp_path / "in", range(8), steps(8), clip=GREY)
    card = read(root, tmp_path / "out")
    assert shown(tmp_path / "out")[0] == list(range(8))
    assert any(DEPTH in note for note in card.source["notes"])
    with pytest.raises(DataError, match="--depth-range"):
        read(root, tmp_path / "depth", cameras=(DEPTH,))
    card = read(root, tmp_path / "both", cameras=(TOP, DEPTH), depth_range=(0.5, 1.5))
    assert (card.environment.frame_size, card.environment.views) == ((48, 128), (TOP, DEPTH))
    wide = EpisodeDataset(tmp_path / "both", "train")[0].video
    assert [number_in(frame[:, :64]) for frame in wide] == list(range(8))
    near = [127 - number_in(frame[:, 64:], grey=True) for frame in wide]  # near is white
    assert near == list(range(8))


def change_action(root, episode, row, value):
    path = root / f"data/{episode:03d}.parquet"
    table = pq.read_table(path).to_pydict()
    table["action"][row][0] = value
    pq.write_table(pa.table(table), path)


@pytest.mark.ci
def test_an_outlier_is_told_and_one_of_a_test_episode_sets_no_bounds(tmp_path):
    root = write(tmp_path / "in", range(8), steps(8), copies=40)
    change_action(root, 39, 3, 1000.0)
    card = read(root, tmp_path / "test")
    assert (card.environment.action.low[0], card.environment.action.high[0]) == (0, 6)
    assert any("ind_test: action_0 from 0 to 1000 was cut" in n for n in card.source["notes"])
    change_action(root, 2, 3, 1000.0)
    card = read(root, tmp_path / "train")
    assert card.environment.action.high[0] == 1000
    assert any("outliers" in n and "--bounds quantile" in n for n in card.source["notes"])
    card = read(root, tmp_path / "robust", bounds="quantile")
    assert card.environment.action.high[0] == 6
    assert shown(tmp_path / "robust", 2)[1] == [0, 1, 2, 6, 4, 5, 6]


def test_all_defects_of_sixty_are_in_one_list_and_the_rest_comes_in_if_asked(tmp_path):
    root = write(tmp_path / "in", range(8), steps(8), copies=60)
    path = root / TOP / "episode_031.mp4"
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    path.write_bytes(data)
    (root / TOP / "episode_007.mp4").write_bytes(data[: len(data) // 2])
    change_action(root, 12, 3, float("nan"))
    with pytest.raises(DataError, match="3 of 60 recordings have defects") as told:
        read(root, tmp_path / "out")
    for name in ("episode 7: ", "episode 31: ", "episode 12: action is not finite in row 3"):
        assert sum(name in line for line in str(told.value).splitlines()) == 1
    card = read(root, tmp_path / "out", on_defect="skip")  # goes on in the same folder
    assert sum(card.splits.values()) == 57
    assert len(card.source["skipped"]) == 3
    assert shown(tmp_path / "out", 7)[0] == list(range(8))
