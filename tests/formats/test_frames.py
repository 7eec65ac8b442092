"""Frames of videos: the colours that the file states, and nothing but videos."""

import av
import numpy as np
import pytest

from acwm_core.errors import DataError
from acwm_formats.frames import ImageFrames, VideoFrames
from tests.formats.corpus.clips import Clip, write_clip
from tests.formats.corpus.pictures import number_in, picture

COLOUR = (200, 30, 40)
MATRICES = {5: (0.299, 0.114), 1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}  # by FFmpeg's number


def luma_and_chroma(space, full):
    """Y, Cb and Cr of `COLOUR`, by the definition of the colour space."""
    kr, kb = MATRICES[space]
    red, green, blue = (value / 255 for value in COLOUR)
    y = kr * red + (1 - kr - kb) * green + kb * blue
    cb, cr = (blue - y) / 2 / (1 - kb), (red - y) / 2 / (1 - kr)
    scale, offset, chroma = (255, 0, 255) if full else (219, 16, 224)
    return [round(offset + scale * y), round(128 + chroma * cb), round(128 + chroma * cr)]


@pytest.mark.parametrize("space", MATRICES)
@pytest.mark.parametrize("full", [False, True])
def test_colours_are_those_that_the_file_states(tmp_path, space, full):
    with av.open(str(tmp_path / "a.mp4"), "w") as output:
        stream = output.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        stream.options = {"qp": "0", "x264-params": "log-level=none"}
        context = stream.codec_context
        context.colorspace, context.color_range = space, 2 if full else 1
        frame = av.VideoFrame(64, 64, "yuv420p")
        for plane, value in zip(frame.planes, luma_and_chroma(space, full), strict=True):
            plane.update(bytes([value]) * plane.buffer_size)
        frame.colorspace, frame.color_range = context.colorspace, context.color_range
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    (image,) = VideoFrames(tmp_path / "a.mp4").read([0])
    assert np.abs(image.reshape(-1, 3).astype(int) - COLOUR).max() <= 3


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_frames_are_upright_from_any_place_on(tmp_path, rotation):
    options = {"g": "4", "bf": "2", "preset": "fast", "x264-params": "log-level=none"}
    write_clip(
        path := tmp_path / "a.mp4",
        range(20),
        [k / 10 for k in range(20)],
        10,
        Clip(rotation=rotation, options=options),
    )
    frames = VideoFrames(path, 3)
    np.testing.assert_allclose(frames.times, 0.3 + np.arange(17) / 10)
    assert frames.size == (48, 64)
    for chosen in ([0, 1, 2], [9, 9, 12], [16]):
        assert [number_in(image) for image in frames.read(chosen)] == [3 + k for k in chosen]


def test_what_is_no_video_is_refused(tmp_path):
    playlist = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\nother.mp4\n"
    for content in (b"", b"text", playlist.encode(), b"\0\0\0\x20ftypisom" + bytes(99)):
        (tmp_path / "a.mp4").write_bytes(content)
        with pytest.raises(DataError, match=r"a\.mp4"):
            _ = VideoFrames(tmp_path / "a.mp4").times
    with pytest.raises(DataError, match=r"b\.mp4"):
        _ = VideoFrames(tmp_path / "b.mp4").size


def test_images_in_memory_are_frames():
    frames = ImageFrames(np.stack([picture(k) for k in range(4)]), np.arange(4.0))
    assert frames.size == (48, 64)
    assert [number_in(image) for image in frames.read([0, 2, 2])] == [0, 2, 2]
