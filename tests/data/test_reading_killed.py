"""Reading that is killed at a hundred random moments goes on as if nothing had happened."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from consuming import BATCH, FRAMES, STEPS, STRIDE, checksum, workers_of

from acwm_core.data.clips import epoch_order
from acwm_core.data.episodes import ClipDataset, EpisodeDataset

HERE = Path(__file__).parent
KILLS = 100


def expected(clips, seed):
    """The clips of every step by the definition of the stream, as checksums."""
    checksums = [
        checksum(clip["video"], clip["actions"])
        for clip in map(clips.__getitem__, range(len(clips)))
    ]
    epochs = -(-STEPS * BATCH // len(clips))
    order = np.concatenate([epoch_order(len(clips), seed, epoch) for epoch in range(epochs)])
    taken = [checksums[index] for index in order[: STEPS * BATCH]]
    return [taken[at : at + BATCH] for at in range(0, len(taken), BATCH)]


def test_a_hundred_kills_change_no_step(square_data, tmp_path):
    subprocess.run(
        [sys.executable, str(HERE / "consuming.py"), str(square_data), str(tmp_path), str(KILLS)],
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        check=True,
        timeout=300,
    )
    assert int((tmp_path / "killed").read_text()) >= KILLS
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=FRAMES, stride=STRIDE)
    folders = [*tmp_path.glob("run-*")]
    redone = {0: 0, 2: 0}
    for folder in folders:
        run = int(folder.name.removeprefix("run-"))
        assert not (folder / "error").exists(), (folder / "error").read_text()
        truth = expected(clips, seed=run)
        lines = [json.loads(line) for line in (folder / "log").read_text().splitlines()]
        assert {step for step, _ in lines} == set(range(STEPS))
        for step, taken in lines:  # also those that a kill undid and the next process did again
            assert taken == truth[step]
        redone[workers_of(run)] += len(lines) - STEPS
    assert min(redone.values()) > 0
