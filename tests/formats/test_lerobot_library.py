"""Where the lerobot library is installed, it reads what acwm wrote for it."""

import numpy as np
import pytest

from acwm_formats.format import export_dataset
from acwm_formats.lerobot import LeRobot
from tests.formats.conftest import episodes_of

datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", exc_type=ImportError)


def test_the_library_reads_it(simulated, tmp_path):
    root = export_dataset(simulated, tmp_path / "out", LeRobot(), progress=False)
    found = datasets.LeRobotDataset("acwm/push_cube", root=root)
    episodes = episodes_of(simulated)
    assert (found.num_episodes, len(found)) == (7, sum(len(e.video) for e in episodes))
    assert found.meta.stats["action"]["q99"].shape == (2,)
    first = 0
    for episode in episodes:
        for t in range(0, len(episode.video), 20):
            item = found[first + t]
            np.testing.assert_array_equal(item["action"].numpy(), episode.actions[t])
            image = item["observation.images.main"].permute(1, 2, 0).numpy() * 255
            assert np.abs(image - episode.video[t]).mean() < 5
            assert item["task"].startswith("A round pusher")
        first += len(episode.video)
    window = {"action": [0, 0.1], "observation.images.main": [-0.1, 0]}
    some = datasets.LeRobotDataset(
        "acwm/push_cube", root=root, episodes=[1, 4], delta_timestamps=window
    )
    assert len(some) == len(episodes[1].video) + len(episodes[4].video)
    assert some[5]["observation.images.main"].shape == (2, 3, 64, 64)
    assert some[5]["action"].shape == (2, 2)
