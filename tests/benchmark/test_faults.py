"""What is handed in wrong is refused in a sentence that names the clip; nothing is skipped."""

import re
import shutil

import numpy as np
import pytest
from PIL import Image

from acwm_benchmark.predictions import find_predictions
from acwm_benchmark.tasks import Tasks
from acwm_core.errors import DataError
from tests.benchmark.participant import WRITERS, to_video

CLIP = "slide/ood_test-000002"


@pytest.fixture(scope="module")
def given(tasks):
    return Tasks(tasks)


@pytest.fixture(scope="module")
def sound(given, tmp_path_factory):
    """Grey predictions of all tasks, as NPZ."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "slide").mkdir()
    for task in given.all:
        write(folder, task.id, np.full((task.frames, 32, 32, 3), 0.5, np.float32))
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "predictions")


def write(folder, task, video, kind="npz"):
    WRITERS[kind](folder / task, video)


def fault(given, folder):
    (world,) = given.worlds(["slide"])
    with pytest.raises(DataError) as told:
        find_predictions(folder, world, given.of("slide")).check()
    return str(told.value)


def test_sound_ones_are_read(given, sound):
    (world,) = given.worlds()
    found = find_predictions(sound, world, given.of("slide"))
    found.check()
    assert found.video(CLIP).shape == (9, 32, 32, 3)
    assert found.coding is None
    assert found.draws == 1


GREY = np.full((9, 32, 32, 3), 0.5, np.float32)
HOLED = GREY.copy()
HOLED[4, 0, 0] = np.nan

WRONG = {
    "too short": ("npz", GREY[:8], "8 frames, not 9"),
    "too long": ("npz", GREY[[*range(9), 0]], "10 frames, not 9"),
    "size": ("npz", GREY[:, :16], "16×32, not 32×32"),
    "not finite": ("npz", HOLED, "not finite in frame 4"),
    "range": ("npz", GREY * 255, "clip them to \\[0, 1\\]"),
    "dtype": ("npz", (GREY * 255).astype(np.int64), "give uint8"),
    "axes": ("npz", GREY.transpose(0, 3, 1, 2), "not \\[T, H, W, 3\\]"),
    "size of video": ("mkv", GREY[:, :16], "16×32, not 32×32"),
    "length of video": ("mp4", GREY[:5], "5 frames, not 9"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_clip_is_told(name, given, folder):
    kind, video, words = WRONG[name]
    (folder / f"{CLIP}.npz").unlink()
    write(folder, CLIP, video, kind)
    said = fault(given, folder)
    assert re.search(f"{CLIP}: .*{words}", said)
    assert ";" not in said  # no other clip is to blame


def test_another_rate_is_told(given, folder):
    (folder / f"{CLIP}.npz").unlink()
    to_video(".mp4", "libx264", "yuv420p", rate=12)(folder / CLIP, GREY)
    assert f"{CLIP}: ood_test-000002.mp4 has 12 frames per second, not 10" in fault(given, folder)


def test_missing_extra_and_double_ones_are_told(given, folder):
    (folder / f"{CLIP}.npz").rename(folder / "slide/ood_test-000009.npz")
    write(folder, "slide/ind_test-000000", GREY, "png")
    said = fault(given, folder)
    assert "ood_test-000009.npz belongs to no task" in said
    assert f"{CLIP}: its prediction is missing" in said
    assert (
        "slide/ind_test-000000: ind_test-000000 and ind_test-000000.npz both belong to it" in said
    )
    assert "holds no predictions of slide" in fault(given, folder / "slide")


def test_worlds_of_no_task_are_told(given):
    with pytest.raises(DataError, match=r"no tasks of 'slid'.*slide"):
        given.worlds(["slid"])
    with pytest.raises(DataError, match="give it to `acwm benchmark export`"):
        given.worlds(["evaluation.metrics=[psnr]"])


def test_numbers_of_draws_are_told(given, folder):
    (folder / f"{CLIP}.npz").unlink()
    for draw in (0, 2):
        write(folder, f"{CLIP}.{draw}", GREY)
    said = fault(given, folder)
    assert said == f"{CLIP}: it has the draws 0, 2, but others 1 from 0 on"


def test_all_are_to_be_coded_alike(given, folder):
    (folder / f"{CLIP}.npz").unlink()
    write(folder, CLIP, GREY, "mp4")
    (world,) = given.worlds()
    with pytest.raises(DataError, match=r"ood_test-000002\.mp4 is h264 .* in one way"):
        find_predictions(folder, world, given.of("slide")).coding  # noqa: B018


def test_damaged_files_are_told(given, folder):
    (folder / f"{CLIP}.npz").write_bytes(b"PK\x03\x04 nothing")
    assert f"{CLIP}: ood_test-000002.npz cannot be read" in fault(given, folder)
    (folder / f"{CLIP}.npz").unlink()
    (folder / f"{CLIP}.mp4").write_bytes(b"#EXTM3U\nfile:///etc/passwd\n")
    assert f"{CLIP}: " in fault(given, folder)
    (folder / f"{CLIP}.mp4").unlink()
    (folder / CLIP).mkdir()
    assert f"{CLIP}: " in fault(given, folder)
    for number in range(9):
        Image.new("RGBA", (32, 32)).save(folder / CLIP / f"{number}.png")
    assert "has opacity" in fault(given, folder)
