"""Lossless video: exact, deterministic bytes, damage noticed; MP4 that others can read."""

import hashlib
import io
import subprocess
import sys

import av
import numpy as np
import pytest

from acwm_core.data.video import (
    Encoding,
    decode_into,
    decode_masks,
    decode_planes,
    decode_video,
    encode_frames,
    encode_masks,
    encode_video,
    write_mp4,
)
from acwm_core.errors import DataError, ShapeError


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def smooth(frames, side):
    t, y, x = np.mgrid[:frames, :side, :side]
    channels = [(x * 3 + t * 5) % 256, (y * 3 + t * 2) % 256, (x + y + t) % 256]
    return np.stack(channels, -1).astype(np.uint8)


@pytest.mark.parametrize(
    "shape", [(5, 32, 32, 3), (1, 16, 24, 3), (4, 33, 47, 3), (3, 240, 400, 3)]
)
def test_video_comes_back_bit_by_bit(shape):
    frames = noise(*shape)
    np.testing.assert_array_equal(decode_video(encode_video(frames)), frames)


def test_every_colour_comes_back():
    colours = np.arange(256, dtype=np.uint8)
    red, green = np.meshgrid(colours, colours)
    frames = np.stack([np.stack([red, green, np.full_like(red, b)], -1) for b in range(0, 256, 51)])
    np.testing.assert_array_equal(decode_video(encode_video(frames)), frames)


@pytest.mark.parametrize("shape", [(6, 32, 32), (2, 33, 47)])
def test_masks_come_back_bit_by_bit(shape):
    masks = noise(*shape)
    np.testing.assert_array_equal(decode_masks(encode_masks(masks)), masks)


def test_another_decoder_path_agrees():
    frames = smooth(8, 64)
    with av.open(io.BytesIO(encode_video(frames, fps=7))) as container:
        stream = container.streams.video[0]
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 7
    np.testing.assert_array_equal(np.stack(decoded), frames)


@pytest.mark.parametrize("pixels", ["yuv444p", "yuv420p", "bgr0"])
@pytest.mark.parametrize("side", [64, 104, 122])
def test_videos_that_others_made_are_decoded_to_the_last_column(side, pixels):
    frames = smooth(6, side)
    codec = "ffv1" if pixels == "bgr0" else "libx264"
    options = {} if pixels == "bgr0" else {"crf": "1"}
    encoding = Encoding("rgb24", pixels, codec, options)
    decoded = decode_video(encode_frames(frames, (side, side), encoding, 10, 6))
    columns = np.abs(decoded.astype(int) - frames).mean((0, 1, 3))
    assert columns.max() < 20


def test_a_part_of_a_video_can_be_decoded():
    frames = smooth(20, 32)
    data = encode_video(frames)
    np.testing.assert_array_equal(decode_video(data, 5, 12), frames[5:12])
    np.testing.assert_array_equal(decode_planes(data, 17), frames[17:].transpose(0, 3, 1, 2))
    with pytest.raises(DataError, match="ends before frames 15 to 21: 5"):
        decode_video(data, 15, 21)


@pytest.mark.parametrize("fps", [3, 7, 10, 24, 30, 60, 999])
def test_any_part_of_a_long_video_can_be_decoded(fps):
    frames = noise(1, 16, 16, 3) + np.arange(100, dtype=np.uint8)[:, None, None, None]
    data = encode_video(frames, fps)
    for start in range(0, 100, 3):
        np.testing.assert_array_equal(decode_video(data, start, start + 1)[0], frames[start])
    np.testing.assert_array_equal(decode_video(data, 61, 98), frames[61:98])
    np.testing.assert_array_equal(decode_video(data, 99), frames[99:])
    with pytest.raises(DataError, match="it ends before"):
        decode_video(data, 100, 101)


def test_a_part_does_not_need_what_comes_long_before_it():
    frames = noise(60, 32, 32, 3)
    data = bytearray(encode_video(frames))
    for place in range(5_000, 15_000):  # within the first frames, too noisy for a decoder to notice
        data[place] ^= 0x55
    assert not np.array_equal(decode_video(bytes(data), 0, 10), frames[:10])
    np.testing.assert_array_equal(decode_video(bytes(data), 40, 50), frames[40:50])


def test_what_stays_the_same_costs_little():
    frames = noise(1, 64, 64, 3).repeat(48, 0)
    assert len(encode_video(frames)) < frames.nbytes / 10


def test_equal_frames_make_equal_bytes_in_another_process():
    program = (
        "import hashlib, numpy as np; from acwm_core.data.video import *;"
        "frames = np.random.default_rng(5).integers(0, 256, (9, 48, 48, 3), np.uint8);"
        "data = encode_video(frames) + encode_masks(frames[..., 0]);"
        "print(hashlib.sha256(data).hexdigest())"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    frames = noise(9, 48, 48, 3, seed=5)
    here = hashlib.sha256(encode_video(frames) + encode_masks(frames[..., 0])).hexdigest()
    assert result.stdout.strip() == here, result.stderr


@pytest.mark.parametrize("data", [b"", b"no video at all", encode_video(smooth(4, 32))[:300]])
def test_what_is_no_video_is_refused(data):
    with pytest.raises(DataError):
        decode_video(data)
    with pytest.raises(DataError):
        decode_masks(data)


def test_frames_of_another_shape_are_refused():
    for bad in (noise(4, 8, 8), noise(4, 8, 8, 4), np.zeros((4, 8, 8, 3)), noise(0, 8, 8, 3)):
        with pytest.raises(ShapeError, match=r"not uint8 \[T, H, W, 3\]"):
            encode_video(bad)
        with pytest.raises(ShapeError, match=r"not uint8 \[H, W, 3\]|at least one frame"):
            write_mp4(io.BytesIO(), bad)
    with pytest.raises(ShapeError, match=r"not uint8 \[T, H, W\]"):
        encode_masks(noise(4, 8, 8, 3))


def test_mp4_is_what_browsers_play(tmp_path):
    frames = smooth(12, 33)
    path, buffer = tmp_path / "film.mp4", io.BytesIO()
    write_mp4(path, frames, fps=10, scale=3)
    write_mp4(buffer, frames, fps=10, scale=3)
    buffer.seek(0)
    for target in (str(path), buffer):
        with av.open(target) as container:
            stream = container.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.pix_fmt == "yuv420p"
            assert stream.average_rate == 10
            decoded = np.stack([f.to_ndarray(format="rgb24") for f in container.decode(stream)])
        assert decoded.shape == (12, 98, 98, 3)  # 99 without the odd row and column
    one_by_one = io.BytesIO()
    write_mp4(one_by_one, iter(frames), fps=10, scale=3)
    assert one_by_one.getvalue() == buffer.getvalue()
    flat = np.full((3, 32, 32, 3), (200, 60, 90), np.uint8)
    write_mp4(path, flat)
    with av.open(str(path)) as container:
        shown = next(container.decode(container.streams.video[0])).to_ndarray(format="rgb24")
    assert np.abs(shown.astype(int) - flat[0]).max() <= 4


@pytest.mark.parametrize("start", [0, 5, 20])
def test_a_batch_can_be_decoded_into(start):
    frames = np.random.default_rng(0).integers(0, 256, (40, 24, 34, 3), np.uint8)
    data = encode_video(frames)
    target = np.zeros((2, 10, 3, 24, 34), np.uint8)
    decode_into(target[1], data, start)
    np.testing.assert_array_equal(target[1], frames[start : start + 10].transpose(0, 3, 1, 2))
    assert not target[0].any()
    with pytest.raises(DataError, match="ends before frame 45: 5 frames"):
        decode_into(target[1], data, 35)
    with pytest.raises(DataError, match="its frames are 24×34, not 34×24"):
        decode_into(np.zeros((3, 3, 34, 24), np.uint8), data, 0)
