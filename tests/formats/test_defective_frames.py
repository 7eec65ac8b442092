"""Repeated and frozen frames beside slow motion, in arrays and after lossy compression."""

import io

import av
import numpy as np
import pytest

from acwm_formats.survey.frames import FrameFacts

SIDE, FRAMES = 64, 64
CODED = [None, 18, 23]


def circling(speed, noise=0.0):
    """A disc that circles over a patterned floor, by so many pixels a frame."""
    rng = np.random.default_rng(0)
    floor = rng.normal(0, 14, (8, 8, 3)).repeat(8, 0).repeat(8, 1)
    floor += (150, 120, 90)
    y, x = np.mgrid[:SIDE, :SIDE]
    video = []
    for t in range(FRAMES):
        turn = speed * t / 14
        away = np.hypot(y - 32 - 14 * np.sin(turn), x - 32 - 14 * np.cos(turn))
        cover = np.clip(6.5 - away, 0, 1)[..., None]
        frame = floor * (1 - cover) + np.array([40, 70, 200]) * cover
        video.append(frame + noise * rng.normal(size=frame.shape))
    return np.stack(video).clip(0, 255).astype(np.uint8)


def coded(video, crf):
    """What is left of it after H.264."""
    if crf is None:
        return video
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.height, stream.width, stream.pix_fmt = *video.shape[1:3], "yuv420p"
        stream.options = {"crf": str(crf)}
        stream.codec_context.thread_count = 1
        for frame in video:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        out.mux(stream.encode())
    with av.open(io.BytesIO(file.getvalue())) as found:
        return np.stack([each.to_ndarray(format="rgb24") for each in found.decode(video=0)])


def facts(video, views=()):
    found = FrameFacts()
    actions = np.random.default_rng(0).normal(size=(len(video) - 1, 2)).astype(np.float32)
    found.add(("train", 0, 0), video.transpose(0, 3, 1, 2), actions, views)
    return found


@pytest.mark.parametrize("crf", CODED)
@pytest.mark.parametrize("noise", [0, 2])
@pytest.mark.parametrize("speed", [0.03, 0.1, 0.3, 1.5])
def test_motion_is_no_defect_however_slow(speed, noise, crf):
    found = facts(coded(circling(speed, noise), crf))
    assert (found.repeated, found.frozen) == (0, 0)


@pytest.mark.parametrize("crf", CODED)
def test_a_doubled_frame_is_found(crf):
    video = circling(1.5)
    video[30] = video[29]
    found = facts(coded(video, crf))
    assert (found.repeated, found.frozen) == (1, 0)
    assert found.examples["repeated"] == [("train", 0, 30)]


@pytest.mark.parametrize("crf", CODED)
def test_a_video_at_half_its_rate_is_found(crf):
    found = facts(coded(circling(1.5)[: FRAMES // 2].repeat(2, 0), crf))
    assert found.repeated > FRAMES / 3


@pytest.mark.parametrize("crf", CODED)
@pytest.mark.parametrize("noise", [0, 2])
def test_a_frozen_stretch_is_found(noise, crf):
    video = circling(1.5, noise)
    video[20:40] = video[19]
    found = facts(coded(video, crf))
    assert 11 <= found.frozen <= 20
    assert found.repeated == 0


def test_a_freeze_amid_slow_motion_is_found_where_frames_are_the_very_same():
    video = circling(0.1)
    video[20:40] = video[19]
    assert facts(video).frozen == 20


def test_one_view_of_two_that_is_frozen_is_found():
    left, right = circling(1.5), circling(1.5)[:, ::-1].copy()
    right[20:40] = right[19]
    wide = np.concatenate([left, right], 2)
    assert facts(wide).frozen == 0
    assert facts(wide, ("left", "right")).frozen == 20
