"""Each recording of the corpus through every format that can hold it: right, or one sentence."""

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from tests.formats.corpus import arrays, files, logs
from tests.formats.corpus.every import ACTIONS, CASES, PIXELS, RATES
from tests.formats.corpus.pictures import number_in

pytestmark = pytest.mark.ci

WRITERS = {
    "videos": files.videos,
    "lerobot": files.lerobot,
    "hdf5 of robomimic": arrays.robomimic,
    "hdf5 of LIBERO": arrays.libero,
    "hdf5 of ALOHA": arrays.aloha,
    "hdf5 of ALOHA with JPEG": arrays.aloha_compressed,
    "hdf5 of somebody": arrays.mapped,
    "zarr": arrays.replay,
    "zarr of version 3": arrays.replay_3,
    "minari": arrays.minari,
    "mcap in JSON": logs.in_json,
    "mcap of ROS 2": logs.in_ros2,
}
"""Write a case to a folder; each returns what to import and the options that the format needs."""

NUMBERS = {"odd size", "tall", "wide", *(case.name for case in (*RATES, *ACTIONS))}
COLOURS = {case.name for case in PIXELS}
IN_COLOUR = ("minari", "mcap in JSON", "mcap of ROS 2", "hdf5 of ALOHA with JPEG")


def holds(writer, case):
    """Whether a format can hold a case."""
    if case.only:
        return writer.split()[0] in case.only
    if writer == "videos":
        return case.clip is not None
    if writer == "lerobot":
        clip = case.clip
        return clip is not None and clip.suffix == "mp4" and "gray" not in clip.pixels
    return case.name in NUMBERS or (case.name in COLOURS and writer not in IN_COLOUR)


READINGS = [(writer, case) for case in CASES for writer in WRITERS if holds(writer, case)]
NAMES = [f"{case.name}, {writer}" for writer, case in READINGS]


def test_the_corpus_is_large():
    assert len({case.name for case in CASES}) == len(CASES) >= 60


@pytest.mark.parametrize(("writer", "case"), READINGS, ids=NAMES)
def test_it_is_right_or_one_sentence(writer, case, tmp_path):
    (source := tmp_path / "source").mkdir()
    path, needed = WRITERS[writer](source, case)
    words = ["data", "import", writer.split()[0], str(path), "--out", str(tmp_path / "out")]
    words += ["--workers", "0", "--test-episodes", "0"]
    for name, value in {**needed, **case.options}.items():
        words += [f"--{name}"] if value is True else [f"--{name}={value}"]
    done = CliRunner().invoke(main, words)
    if case.refused:
        assert done.exit_code == 2, done.output
        assert case.refused in done.stderr
        assert "Traceback" not in done.stderr
        return
    assert done.exit_code == 0, done.output
    assert case.told in done.output
    episodes = list(EpisodeDataset(tmp_path / "out", "train"))
    assert [shown(case, each) for each in episodes] == [numbers for numbers, _ in case.right]
    for episode, (_, rows) in zip(episodes, case.right, strict=True):
        wanted = np.asarray(rows, np.float32)
        np.testing.assert_allclose(episode.actions[:-1], wanted, rtol=1e-3, atol=1e-5)
        assert not episode.actions[-1].any()
        assert episode.video.shape[1:3] == tuple(side // 8 * 8 for side in case.size)


def shown(case, episode):
    """The numbers of the frames; of depth, what is near is white."""
    frames = 255 - episode.video if case.depth else episode.video
    return tuple(int(number_in(frame, case.grey or case.depth)) for frame in frames)
