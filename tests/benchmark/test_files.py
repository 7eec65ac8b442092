"""Files of predictions are read as they are: sixteen bits, the order of numbers, still frames."""

import av
import numpy as np
import pytest
from PIL import Image

from acwm_benchmark.lossy import LossyClip, LossyVideo
from acwm_benchmark.videos import Wanted, coding_of
from acwm_benchmark.videos import read_video as read
from tests.benchmark.participant import WRITERS, to_gif, to_video


def read_video(path, fps, frames=12, side=32):
    return read(path, fps, Wanted(frames, side, side))


@pytest.fixture
def video():
    """Twelve frames of a square that moves over a slope of colours."""
    rows, columns = np.mgrid[:32, :32] / 40
    frames = np.stack([np.stack([rows, columns, 0.8 - rows * columns], -1)] * 12)
    for number, frame in enumerate(frames):
        frame[8:16, number : number + 8] = (0.9, 0.1, 0.2)
    return frames.astype(np.float32)


def test_pictures_of_sixteen_bits_keep_them(tmp_path):
    pixels = np.arange(16 * 16 * 3, dtype=np.uint16).reshape(16, 16, 3) * 85
    with av.open(str(tmp_path / "0.png"), "w", format="image2") as file:
        stream = file.add_stream("png", rate=10)
        stream.height = stream.width = 16
        stream.pix_fmt = "rgb48be"
        file.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb48le")))
        file.mux(stream.encode(None))
    np.testing.assert_allclose(read_video(tmp_path, 10, 1, 16)[0], pixels / 65535, atol=1e-7)


def test_pictures_are_ordered_by_number(tmp_path):
    for number in range(12):
        Image.new("RGB", (8, 8), (number * 20,) * 3).save(tmp_path / f"{number}.png")
    found = read_video(tmp_path, 10, 12, 8)[:, 0, 0, 0] * 255
    np.testing.assert_allclose(found, np.arange(12) * 20, atol=1e-4)


def test_a_gif_may_leave_out_frames_that_stand_still(tmp_path, video):
    still = video[[0, 0, 0, 1, 2, 2]]
    to_gif(tmp_path / "clip", still)
    with Image.open(tmp_path / "clip.gif") as stored:
        assert stored.n_frames < 6
    found = read_video(tmp_path / "clip.gif", 10, 6)
    assert found.shape == still.shape
    assert np.abs(found - still).mean() < 0.03


@pytest.mark.parametrize("kind", ["npz", "mkv"])
def test_lossless_files_lose_nothing(kind, tmp_path, video):
    video = (video * 255).round().astype(np.float32) / 255
    WRITERS[kind](tmp_path / "clip", video)
    np.testing.assert_allclose(read_video(tmp_path / f"clip.{kind}", 10), video, atol=1e-6)


CODECS = {
    "fine H.264": to_video(".mp4", "libx264", "yuv420p", crf="16"),
    "coarse H.264": to_video(".mp4", "libx264", "yuv420p", crf="34"),
    "full colour": to_video(".mkv", "libx264", "yuv444p", crf="20"),
    "MPEG-4": to_video(".mp4", "mpeg4", "yuv420p", qmin="6", qmax="6"),
    "VP9": to_video(".webm", "libvpx-vp9", "yuv420p", crf="34", b="0"),
    "GIF": to_gif,
}


@pytest.mark.parametrize("name", CODECS)
def test_the_loss_that_is_measured_is_that_of_the_file(name, tmp_path, video):
    """Measured on the very frames of the file, so that its true loss is known."""
    import torch

    CODECS[name](tmp_path / "clip", video)
    (path,) = tmp_path.iterdir()
    handed_in = LossyClip(path.stat().st_size, read_video(path, 10))
    true = np.abs(handed_in.video - video).mean()
    codec = LossyVideo(coding_of(path), [handed_in], 10)
    again = codec(torch.as_tensor(video).permute(0, 3, 1, 2)[None])[0]
    measured = np.abs(again.permute(0, 2, 3, 1).numpy() - video).mean()
    assert true > 0.002
    assert measured == pytest.approx(true, rel=0.35)
