"""Videos of strangers: what claims too much is refused in one sentence, before memory is taken."""

import contextlib
import random
import resource

import pytest

from acwm_core.errors import DataError
from acwm_formats.frames import VideoFrames, video_index
from tests.formats import video_bombs
from tests.formats.corpus import files
from tests.formats.test_hostile_sources import PLAIN, refused, run


def memory():
    """The most memory that the process has taken, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("name", video_bombs.BOMBS)
def test_bombs_are_refused(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(video_bombs.BOMBS[name]())
    before = memory()
    with pytest.raises(DataError) as error:
        video_index(path)
    assert path.name in str(error.value)
    assert "\n" not in str(error.value)
    assert memory() - before < 300


@pytest.mark.parametrize(
    ("container", "codec", "options"),
    [
        ("mp4", "libx264", ()),
        ("mp4", "libx264", (("movflags", "frag_keyframe+empty_moov+default_base_moof"),)),
        ("mov", "mpeg4", ()),
        ("avi", "mpeg4", ()),
        ("matroska", "ffv1", ()),
    ],
)
def test_sound_videos_are_read(tmp_path, container, codec, options):
    path = tmp_path / "sound"
    path.write_bytes(video_bombs.video(container, codec=codec, options=options))
    index = video_index(path)
    assert (len(index.ticks), index.size) == (8, (32, 32))


def test_an_import_ends_by_the_sentence(tmp_path):
    (tmp_path / "source").mkdir()
    files.videos(tmp_path / "source", PLAIN)
    (tmp_path / "source/take_9.mp4").write_bytes(video_bombs.BOMBS["samples.mp4"]())
    said = refused(run("videos", tmp_path / "source", tmp_path / "data", {}))
    assert "take_9.mp4 claims 170,000,000 frames, and has 1,737 bytes" in said


@pytest.mark.parametrize("container", ["mp4", "matroska", "avi", "mov"])
def test_damage_of_every_kind_is_a_sentence(tmp_path, container):
    """Random bytes of headers and frames."""
    data = video_bombs.video(container, codec="mpeg4")
    rng = random.Random(0)
    for number in range(150):
        changed = bytearray(data)
        place = rng.randrange(len(data) - 4)
        changed[place : place + 4] = rng.choice([b"\xff" * 4, bytes(4), rng.randbytes(4)])
        path = tmp_path / f"{number}"
        path.write_bytes(changed)
        frames = VideoFrames(path)
        with contextlib.suppress(DataError):
            [*frames.read(range(min(len(frames.times), 8)))]
